"""A source of binary frames that lie one after the other in files."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from threading import local

import numpy as np
from numpy.typing import NDArray

from photonpano.reading.binary_source import BinarySource
from photonpano.reading.packed_layout import FrameLayout
from photonpano.values import FrameSpan

_READ_BYTES = 1024**2
"""Bytes read at once: they stay in the cache of a core until they are summed."""


@dataclass(frozen=True, slots=True)
class FrameFile:
    """Consecutive frames in a file.

    Attributes:
        path: the file.
        n_frames: number of the frames.
        offset: start of the first of them, in bytes.
    """

    path: Path
    n_frames: int
    offset: int = 0


class PackedFileSource(BinarySource):
    """Binary frames in one file or in many.

    Files are read in pieces, because memory-mapped files would fill the memory of the process.
    """

    def __init__(
        self,
        files: Sequence[FrameFile],
        layout: FrameLayout,
        frame_rate_hz: float | None = None,
    ) -> None:
        """Take files in the order of their frames.

        Args:
            files: at least one, each long enough for its frames, of which it has at least one.
            layout: order of the pixels of a frame in its bytes.
            frame_rate_hz: frames per second; None if unknown.
        """
        self._parts = tuple(files)
        self._starts = list(accumulate((file.n_frames for file in files), initial=0))
        self._buffers = local()
        super().__init__(self._starts[-1], layout, frame_rate_hz)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time: see `BinarySource`."""
        step = max(1, _READ_BYTES // self.layout.stored_bytes)
        index, start = bisect_right(self._starts, span.start) - 1, span.start
        while start < span.stop:
            stop = min(start + step, self._starts[index + 1], span.stop)
            yield slice(start - span.start, stop - span.start), self._rows(index, start - self._starts[index], stop - start)
            index += stop == self._starts[index + 1]
            start = stop

    def _rows(self, index: int, first: int, n_frames: int) -> NDArray[np.uint8]:
        file, frame_bytes = self._parts[index], self.layout.stored_bytes
        target = self._buffer(n_frames * frame_bytes)
        self.files.read(file.path, file.offset + first * frame_bytes, target)
        return self.layout.rows(target.reshape(n_frames, *self.layout.stored_shape))

    def _buffer(self, size: int) -> NDArray[np.uint8]:
        """Return a buffer of the thread."""
        buffer: NDArray[np.uint8] | None = getattr(self._buffers, "bytes", None)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers.bytes = np.empty(size, np.uint8)
        return buffer[:size]
