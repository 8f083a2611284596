"""Base classes of sources: of binary frames in packed bytes, whose order is a `FrameLayout`, and of single frames.

`PackedFileSource` reads frames that lie one after the other in files, pieces of them fetched ahead.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce
from itertools import accumulate, pairwise
from threading import Lock, local
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.protocols import Closing as Closing
from photonpano.files.paths import Location, Url
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
    """

    def __init__(self, n_frames: int, layout: FrameLayout, frame_rate_hz: float | None = None) -> None:
        self.info = StreamInfo(n_frames, *layout.frame_shape, frame_rate_hz)
        self.response: Response = BinaryResponse()
        self.valid = np.ones(layout.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self.layout = layout

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


_KEPT = 32  # pieces kept, the latest ones
_AHEAD = 6  # pieces fetched ahead of the one that is read
_FETCHED_AT_ONCE = 8
_ENDS = 64  # ends of spans remembered: a span that begins at one of them continues it
_SMALL = 4  # a span below 1/4 of a piece is fetched alone, unless it continues another

Fetch = Callable[[FrameSpan], NDArray[np.uint8]]
_READ_BYTES = 1024**2  # read at once: they stay in the cache of a core until they are summed
_PIECE_BYTES = 4 * 1024**2  # fetched from a URL at once: a request takes milliseconds, whatever its size


class Pieces:
    """Frames in pieces that are fetched in threads of their own.

    Pieces are fetched ahead as far as a span reaches, and further where one span goes on from another. So single spans cost
    what they hold, and a capture that is read in order comes in the longest pieces that memory allows.
    """

    def __init__(self, starts: Sequence[int], fetch: Fetch, *, in_parts: bool = True) -> None:
        """Take the borders of the pieces.

        Args:
            starts: the first frame of each piece, and the number of frames as the last item.
            fetch: returns the frames of a span within one piece, (n, ...), in any thread.
            in_parts: whether a part of a piece can be fetched for less than the whole.
        """
        self._starts = list(starts)
        self._fetch = fetch
        self._in_parts = in_parts
        self._lock = Lock()
        self._pool = ThreadPoolExecutor(_FETCHED_AT_ONCE, "pieces")
        self._kept: OrderedDict[int, Future[NDArray[np.uint8]]] = OrderedDict()
        self._ends: deque[int] = deque(maxlen=_ENDS)

    def of(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, piece by piece, with their places in the span; they must not be written to."""
        first, last = (bisect_right(self._starts, frame) - 1 for frame in (span.start, span.stop - 1))
        with self._lock:
            goes_on = span.start in self._ends
            self._ends.append(span.stop)
        for index in range(first, last + 1):
            piece = FrameSpan(self._starts[index], self._starts[index + 1])
            start, stop = max(span.start, piece.start), min(span.stop, piece.stop)
            place = slice(start - span.start, stop - span.start)
            if self._in_parts and not goes_on and _SMALL * len(span) < len(piece) and not self._has(index):
                yield place, self._fetch(FrameSpan(start, stop))
            else:
                frames = self._piece(index, len(self._starts) if goes_on else last)
                yield place, frames[start - piece.start : stop - piece.start]

    def _has(self, index: int) -> bool:
        with self._lock:
            return index in self._kept

    def _piece(self, index: int, last: int) -> NDArray[np.uint8]:
        with self._lock:
            wanted = [self._asked(each) for each in range(index, min(index + _AHEAD, last, len(self._starts) - 2) + 1)]
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        try:
            return wanted[0].result()
        except Exception:
            with self._lock:  # the next reader tries again
                if self._kept.get(index) is wanted[0]:
                    del self._kept[index]
            raise

    def _asked(self, index: int) -> Future[NDArray[np.uint8]]:
        if index not in self._kept:
            self._kept[index] = self._pool.submit(self._fetch, FrameSpan(self._starts[index], self._starts[index + 1]))
        self._kept.move_to_end(index)
        return self._kept[index]

    def close(self) -> None:
        """Forget the pieces, and fetch no more of them."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._kept.clear()


@dataclass(frozen=True, slots=True)
class FrameFile:
    """Consecutive frames in a file."""

    path: Location  # the file, or its URL
    n_frames: int  # number of the frames
    offset: int = 0  # start of the first of them, in bytes


class StoredFrames:
    """The bytes of frames in one file or in many, for any number of threads.

    Files are read in pieces, because memory-mapped files would fill the memory of the process.
    """

    def __init__(self, files: Sequence[FrameFile], shape: tuple[int, ...]) -> None:
        """Take at least one file, in the order of frames, each long enough; `shape` is that of the bytes of a frame."""
        self._parts, self._shape, self._frame_bytes = tuple(files), shape, math.prod(shape)
        self._starts = list(accumulate((file.n_frames for file in files), initial=0))
        self.n_frames = self._starts[-1]
        self._files, self._buffers = OpenFiles(), local()
        self._remote = None
        if any(isinstance(file.path, Url) for file in files):
            step = max(1, _PIECE_BYTES // self._frame_bytes)
            starts = [first for start, stop in pairwise(self._starts) for first in range(start, stop, step)]
            self._remote = Pieces([*starts, self.n_frames], self._fetched)

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield some frames of a span at a time, (n, *shape), and their place in it; the next step may overwrite them."""
        if self._remote is not None:
            yield from self._remote.of(span)
            return
        step = max(1, _READ_BYTES // self._frame_bytes)
        index, start = self._file_of(span.start), span.start
        while start < span.stop:
            stop = min(start + step, self._starts[index + 1], span.stop)
            target = self._buffer((stop - start) * self._frame_bytes).reshape(stop - start, *self._shape)
            yield slice(start - span.start, stop - span.start), self._read(index, start, target)
            index += stop == self._starts[index + 1]
            start = stop

    def _file_of(self, frame: int) -> int:
        return bisect_right(self._starts, frame) - 1

    def _fetched(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span within one file."""
        return self._read(self._file_of(span.start), span.start, np.empty((len(span), *self._shape), np.uint8))

    def _read(self, index: int, first: int, target: NDArray[np.uint8]) -> NDArray[np.uint8]:
        file = self._parts[index]
        self._files.read(file.path, file.offset + (first - self._starts[index]) * self._frame_bytes, target)
        return target

    def _buffer(self, size: int) -> NDArray[np.uint8]:
        """Return a buffer of the thread."""
        buffer: NDArray[np.uint8] | None = getattr(self._buffers, "bytes", None)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers.bytes = np.empty(size, np.uint8)
        return buffer[:size]

    def close(self) -> None:
        """Close the files."""
        self._files.close()
        if self._remote is not None:
            self._remote.close()


class PackedFileSource(BinarySource):
    """Binary frames in one file or in many."""

    def __init__(self, files: Sequence[FrameFile], layout: FrameLayout, frame_rate_hz: float | None = None) -> None:
        """Take at least one file, in the order of frames; see `StoredFrames`."""
        self._stored = StoredFrames(files, layout.stored_shape)
        super().__init__(self._stored.n_frames, layout, frame_rate_hz)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time: see `BinarySource`."""
        yield from ((place, self.layout.rows(stored)) for place, stored in self._stored.blocks(span))

    def close(self) -> None:
        """Close the files."""
        self._stored.close()
