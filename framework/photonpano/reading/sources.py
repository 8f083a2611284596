"""Base classes of sources: of binary frames in packed bytes, whose order is a `FrameLayout`, and of single frames."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.protocols import Closing as Closing
from photonpano.photometry import BinaryResponse, BitOrder, packed_counts, reversed_bits
from photonpano.reading.files import OpenFiles
from photonpano.values import Counts, FloatArray, Frames, FrameSpan, Response, StreamInfo

Pixels = TypeVar("Pixels", bound=np.generic)


class Arrangement(Protocol):
    """Moves blocks of stored images to their places in the image."""

    def __call__(self, images: NDArray[Pixels], /) -> NDArray[Pixels]:
        """Return (..., height, columns) of (..., rows, columns), where a column is a pixel or a byte of eight pixels.

        The pixels of a byte stay together. The argument must not be changed.
        """


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """The order of the pixels of a binary frame in its bytes.

    Pixels are reordered once in a sum of frames, and not in each frame.
    """

    frame_shape: tuple[int, int]  # (height, width) of the image
    stored_shape: tuple[int, ...]  # the shape of the bytes of a frame: its packed rows, unless there is a `to_rows`
    bit_order: BitOrder = "big"  # "big" if the first pixel is the highest bit of a byte, "little" if it is the lowest
    arranged: Arrangement | None = None  # turns stored images into images; None if their rows are those of the image
    # turns (n, *stored_shape) into (n, rows, bytes of a row), packed along the width; None if frames are stored so
    to_rows: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None

    @property
    def stored_bytes(self) -> int:
        """Bytes of a frame in the file."""
        return math.prod(self.stored_shape)

    def rows(self, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the packed rows (n, rows, bytes of a row) of stored frames (n, *stored_shape)."""
        return stored if self.to_rows is None else self.to_rows(stored)

    def unpacked(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Unpack packed rows to frames (n, H, W)."""
        return self.image(np.unpackbits(rows, axis=-1, bitorder=self.bit_order))

    def packed(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return frames packed as by numpy, (n, H, ceil(W / 8)), which may share memory with `rows`."""
        packed = rows if self.bit_order == "big" else reversed_bits(rows)
        if self.arranged is not None:
            packed = self.arranged(packed)
        if beyond := -self.frame_shape[1] % 8:
            packed = packed.copy()
            packed[..., -1] &= 0xFF << beyond & 0xFF
        return packed

    def image(self, pixels: NDArray[Pixels]) -> NDArray[Pixels]:
        """Return (..., H, W) of pixels (..., rows, 8 times the bytes of a row)."""
        arranged = pixels if self.arranged is None else self.arranged(pixels)
        return np.ascontiguousarray(arranged[..., : self.frame_shape[1]])


class BinarySource(Closing, ABC):
    """Binary frames, eight pixels to a byte: a `photonpano.PackedSource`. A subclass reads the bytes.

    Attributes:
        info: frames, size, rate.
        response: that of binary frames of single photons, unless the subclass, or who makes the source, sets another.
        valid: (H, W) mask, True everywhere: files do not mark bad pixels.
        layout: order of the pixels of a frame in its bytes.
        files: reads pieces of files.
    """

    def __init__(self, n_frames: int, layout: FrameLayout, frame_rate_hz: float | None = None) -> None:
        self.info = StreamInfo(n_frames, *layout.frame_shape, frame_rate_hz)
        self.response: Response = BinaryResponse()
        self.valid = np.ones(layout.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self.layout = layout
        self.files = OpenFiles()

    @abstractmethod
    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the place of some frames in a span, and their packed rows, (n, rows, bytes of a row).

        The next step may overwrite the rows. An `InputError` says why frames cannot be read.
        """

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        sums: Counts | None = None
        for _, rows in self.pieces(span):
            sums = packed_counts(rows, 8 * rows.shape[-1], sums, self.layout.bit_order)
        assert sums is not None, "a span is never empty"
        return self.layout.image(sums)

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        self.info.require(span)
        frames = np.empty((len(span), *self.info.frame_shape), np.uint8)
        for place, rows in self.pieces(span):
            frames[place] = self.layout.unpacked(rows)
        return frames

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        self.info.require(span)
        frames = np.empty((len(span), self.info.height, -(-self.info.width // 8)), np.uint8)
        for place, rows in self.pieces(span):
            frames[place] = self.layout.packed(rows)
        return frames

    def close(self) -> None:
        """Close the files."""
        self.files.close()


class ThreeChannels(Closing):
    """Binary frames whose pixels see red, green and blue at once: a `photonpano.ColouredSource`, which is packed.

    A pixel of its grey frames is lit where it is lit in any channel. So they are the frames of pixels without filters: the flux
    is the sum of the three.
    """

    def __init__(self, opened: Callable[[int | None], BinarySource]) -> None:
        """Take what opens the frames of a channel, 0 to 2 for red, green and blue, or the grey ones for None."""
        self._grey = opened(None)
        self._channels = {name: opened(channel) for channel, name in enumerate(("red", "green", "blue"))}
        self.info, self.response, self.valid = self._grey.info, self._grey.response, self._grey.valid
        self.counts, self.frames, self.packed = self._grey.counts, self._grey.frames, self._grey.packed

    def colours(self) -> Mapping[str, BinarySource]:
        """Return a source for each channel: see `photonpano.ColouredSource`."""
        return self._channels

    def clear_mix(self) -> FloatArray:
        """Return the flux of the grey frames as factors of that of the channels: see `photonpano.ColouredSource`."""
        return np.ones(len(self._channels))

    def close(self) -> None:
        """Close the files."""
        for source in (self._grey, *self._channels.values()):
            source.close()


def of_channel(values: NDArray[Any], channel: int | None) -> NDArray[Any]:
    """Return a channel of values (..., 3), bits or bytes of eight bits; what is lit in any channel for None."""
    return reduce(np.bitwise_or, np.moveaxis(values, -1, 0)) if channel is None else values[..., channel]


class BlockSource(Closing, ABC):
    """Sums and spans of frames of values. A subclass yields frames, and has what is missing for a `photonpano.Source`."""

    info: StreamInfo  # frames, size, rate; the subclass sets it

    @abstractmethod
    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield some frames of a span at a time, (n, H, W), whose values fit into the bits of `info`, and their place in it.

        An `InputError` says why frames cannot be read.
        """

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for _, values in self.blocks(span):
            counts += values.sum(axis=0, dtype=np.uint32)
        return counts

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span: (n, H, W) uint8, or uint16 of more than eight bits."""
        self.info.require(span)
        shape = len(span), *self.info.frame_shape
        frames: Frames = np.empty(shape, np.uint8) if self.info.bit_depth <= 8 else np.empty(shape, np.uint16)
        for place, values in self.blocks(span):
            frames[place] = values
        return frames


class SingleFrameSource(BlockSource):
    """Frames that are made or read one by one. A subclass gives a frame."""

    @abstractmethod
    def frame(self, index: int) -> NDArray[np.bool_] | Frames:
        """Return a frame of the capture, (H, W), whose values fit into the bits of `info`, or raise an `InputError`."""

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the frames of a span one by one."""
        for place, index in enumerate(range(span.start, span.stop)):
            yield slice(place, place + 1), self.frame(index)[None]
