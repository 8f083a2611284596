"""A source of binary frames that lie in files, eight pixels to a byte."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate
from threading import local
from typing import TYPE_CHECKING

import numpy as np

from photonpano.photometry import BinaryResponse
from photonpano.reading.files import OpenFiles
from photonpano.values import FrameSpan, StreamInfo

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray

    from photonpano.reading.packed_layout import FrameLayout
    from photonpano.values import BoolArray, Counts

_READ_BYTES = 1024**2
"""So much is read at a time: a core's cache holds it until it is summed."""


@dataclass(frozen=True, slots=True)
class FrameFile:
    """Frames, one after the other, in a file.

    Attributes:
        path: the file.
        n_frames: how many of its frames are meant.
        offset: where the first of them begins, in bytes.
    """

    path: Path
    n_frames: int
    offset: int = 0


class PackedFileSource:
    """Binary frames in one file or in many: a `photonpano.PackedSource`.

    Files are read a little at a time, since mapped ones would fill the memory of the process.
    """

    def __init__(
        self,
        files: Sequence[FrameFile],
        layout: FrameLayout,
        frame_rate_hz: float | None = None,
        valid: BoolArray | None = None,
    ) -> None:
        """Take files in the order of their frames.

        Args:
            files: at least one, with at least one frame each; they must be long enough.
            layout: how the pixels of a frame lie in its bytes.
            frame_rate_hz: frames a second, None if unknown.
            valid: (H, W), false for pixels that must not be used; by default all may be.
        """
        self._files = tuple(files)
        self._starts = list(accumulate((file.n_frames for file in files), initial=0))
        self._layout = layout
        self._opened = OpenFiles()
        self._buffers = local()
        self.info = StreamInfo(self._starts[-1], *layout.frame_shape, frame_rate_hz)
        self.response = BinaryResponse()
        self.valid = np.ones(layout.frame_shape, np.bool_) if valid is None else valid

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        sums = None
        for _, rows in self._pieces(span):
            sums = self._layout.add_counts(rows, sums)
        assert sums is not None, "a span is never empty"
        return self._layout.image(sums)

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        frames = np.empty((len(span), *self.info.frame_shape), np.uint8)
        for place, rows in self._pieces(span):
            frames[place] = self._layout.unpacked(rows)
        return frames

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        frames = np.empty((len(span), self.info.height, -(-self.info.width // 8)), np.uint8)
        for place, rows in self._pieces(span):
            frames[place] = self._layout.packed(rows)
        return frames

    def close(self) -> None:
        """Let go of the files."""
        self._opened.close()

    def _pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield which frames of the span these are, and their packed rows, which the next step overwrites."""
        self.info.require(span)
        step = max(1, _READ_BYTES // self._layout.stored_bytes)
        index, start = bisect_right(self._starts, span.start) - 1, span.start
        while start < span.stop:
            stop = min(start + step, self._starts[index + 1], span.stop)
            yield slice(start - span.start, stop - span.start), self._rows(index, start - self._starts[index], stop - start)
            index += stop == self._starts[index + 1]
            start = stop

    def _rows(self, index: int, first: int, n_frames: int) -> NDArray[np.uint8]:
        file, frame_bytes = self._files[index], self._layout.stored_bytes
        target = self._buffer(n_frames * frame_bytes)
        self._opened.read(file.path, file.offset + first * frame_bytes, target)
        return self._layout.rows(target.reshape(n_frames, *self._layout.stored_shape))

    def _buffer(self, size: int) -> NDArray[np.uint8]:
        """Return memory of the thread."""
        buffer: NDArray[np.uint8] | None = getattr(self._buffers, "bytes", None)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers.bytes = np.empty(size, np.uint8)
        return buffer[:size]

    def __enter__(self) -> PackedFileSource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
