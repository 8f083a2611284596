"""Frames in a .npy file, a pixel to a value: binary frames, and sums of binary frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError, Location, StreamInfo, Url
from photonpano.photometry import BinarySumResponse
from photonpano.reading import BinarySource, BlockSource, FrameFile, FrameLayout, NpyHeader, StoredFrames, of_channel

_BLOCK_BYTES = 4 * 1024**2  # read at once of frames along the last axis, which are scattered over the file
_NO_BIT = "bits are 0 and 1, or 0 and 255; write holds: sums for sums, or use packed-npy for bytes of eight pixels"


class Values:
    """Reads the values of frames in a .npy file, from any thread."""

    def __init__(self, path: Location, header: NpyHeader, frames_last: bool) -> None:
        """Take an array whose first or last axis is that of frames; raises an `InputError` if it is the last at a URL.

        If the frames are first, there may be a fourth axis, of channels.
        """
        n_frames, height, width, *_ = header.shape[-1:] + header.shape[:-1] if frames_last else header.shape
        self.path, self.shape, self._dtype = path, (n_frames, height, width), header.dtype
        self._stored: StoredFrames | None = None
        if not frames_last:
            stored_shape = *header.shape[1:-1], header.shape[-1] * header.dtype.itemsize
            self._stored = StoredFrames([FrameFile(path, n_frames, header.offset)], stored_shape)
        elif isinstance(path, Url):
            raise InputError(f"{path} has its frames along the last axis, scattered over the file; download it, and convert it")
        else:
            self._scattered = np.memmap(path, header.dtype, "r", header.offset, header.shape)

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield some frames of a span at a time, (n, H, W) or (n, H, W, 3), and their place in it.

        The next step may overwrite them.
        """
        if self._stored is not None:
            yield from ((place, stored.view(self._dtype)) for place, stored in self._stored.blocks(span))
            return
        frame_bytes = self.shape[1] * self.shape[2] * self._dtype.itemsize
        for block in span.blocks(max(1, _BLOCK_BYTES // frame_bytes)):
            values = np.moveaxis(self._scattered[..., block.start : block.stop], -1, 0)
            yield slice(block.start - span.start, block.stop - span.start), np.ascontiguousarray(values)

    def require(self, wrong: NDArray[np.bool_], values: NDArray[Any], first: int, remedy: str) -> None:
        """Raise for the first of the values, of frames from `first` on, that is wrong."""
        if wrong.any():
            frame, row, column, *_ = np.argwhere(wrong)[0].tolist()
            raise InputError(
                f"{self.path} holds the value {values[wrong][0]} in frame {first + frame}, row {row}, column {column}; {remedy}"
            )

    def close(self) -> None:
        """Close the file."""
        if self._stored is not None:
            self._stored.close()


class NpyBits(BinarySource):
    """Binary frames, a pixel to a value; reading them raises an `InputError` for a value that is not a bit."""

    def __init__(self, values: Values, frame_rate_hz: float | None, channel: int | None = None) -> None:
        """Take values, and the channel of those with channels, or None for what is lit in any."""
        n_frames, height, width = values.shape
        super().__init__(n_frames, FrameLayout((height, width), (height, -(-width // 8))), frame_rate_hz)
        self._values, self._channel = values, channel

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, packed: see `BinarySource`."""
        for place, values in self._values.blocks(span):
            if values.max() > 1 or values.min() < 0:
                wrong = (values != 0) & (values != 1) & (values != 255)
                self._values.require(wrong, values, span.start + place.start, _NO_BIT)
            lit = values != 0
            yield place, np.packbits(of_channel(lit, self._channel) if lit.ndim == 4 else lit, axis=2)

    def close(self) -> None:
        """Close the file."""
        self._values.close()


class NpySums(BlockSource):
    """Sums of binary frames: a `photonpano.Source`; reading one with a value that is too large raises an `InputError`."""

    def __init__(self, values: Values, binary_frames: int, frame_rate_hz: float | None) -> None:
        self.info = StreamInfo(*values.shape, frame_rate_hz, "intensity", binary_frames.bit_length())
        self.response = BinarySumResponse(binary_frames)
        self.valid = np.ones(self.info.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self._values = values

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the frames of a span, a few at a time: see `BlockSource`."""
        most = self.response.n
        for place, values in self._values.blocks(span):
            if values.max() > most or values.min() < 0:
                remedy = f"sums of frames_per_sum: {most} go from 0 to {most}; correct frames_per_sum"
                self._values.require((values < 0) | (values > most), values, span.start + place.start, remedy)
            yield place, values

    def close(self) -> None:
        """Close the file."""
        self._values.close()
