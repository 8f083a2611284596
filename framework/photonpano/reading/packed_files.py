"""A source of binary frames that lie one after the other in files."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from threading import local

import numpy as np
from numpy.typing import NDArray

from photonpano.paths import Location, Url
from photonpano.reading.binary_source import BinarySource
from photonpano.reading.packed_layout import FrameLayout
from photonpano.reading.pieces import Pieces
from photonpano.values import FrameSpan

_READ_BYTES = 1024**2  # read at once: they stay in the cache of a core until they are summed
_PIECE_BYTES = 4 * 1024**2  # fetched from a URL at once: a request takes milliseconds, whatever its size


@dataclass(frozen=True, slots=True)
class FrameFile:
    """Consecutive frames in a file.

    Attributes:
        path: the file, or its URL.
        n_frames: number of the frames.
        offset: start of the first of them, in bytes.
    """

    path: Location
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
        self._remote = None
        if any(isinstance(file.path, Url) for file in files):
            step = max(1, _PIECE_BYTES // layout.stored_bytes)
            starts = [first for start, stop in pairwise(self._starts) for first in range(start, stop, step)]
            self._remote = Pieces([*starts, self._starts[-1]], self._fetched)

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, a few at a time: see `BinarySource`."""
        if self._remote is not None:
            yield from ((place, self.layout.rows(stored)) for place, stored in self._remote.of(span))
            return
        step = max(1, _READ_BYTES // self.layout.stored_bytes)
        index, start = bisect_right(self._starts, span.start) - 1, span.start
        while start < span.stop:
            stop = min(start + step, self._starts[index + 1], span.stop)
            yield slice(start - span.start, stop - span.start), self._rows(index, start - self._starts[index], stop - start)
            index += stop == self._starts[index + 1]
            start = stop

    def _rows(self, index: int, first: int, n_frames: int) -> NDArray[np.uint8]:
        target = self._buffer(n_frames * self.layout.stored_bytes)
        return self.layout.rows(self._read(index, first, target).reshape(n_frames, *self.layout.stored_shape))

    def _fetched(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the stored frames of a span within one file: (n, *stored_shape)."""
        index = bisect_right(self._starts, span.start) - 1
        stored = np.empty((len(span), *self.layout.stored_shape), np.uint8)
        return self._read(index, span.start - self._starts[index], stored)

    def _read(self, index: int, first: int, target: NDArray[np.uint8]) -> NDArray[np.uint8]:
        file = self._parts[index]
        self.files.read(file.path, file.offset + first * self.layout.stored_bytes, target)
        return target

    def _buffer(self, size: int) -> NDArray[np.uint8]:
        """Return a buffer of the thread."""
        buffer: NDArray[np.uint8] | None = getattr(self._buffers, "bytes", None)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers.bytes = np.empty(size, np.uint8)
        return buffer[:size]

    def close(self) -> None:
        """Close the files."""
        super().close()
        if self._remote is not None:
            self._remote.close()
