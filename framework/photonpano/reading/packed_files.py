"""Frames that lie one after the other in files, pieces of them fetched ahead, and the source of those that are binary."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate, pairwise
from threading import Lock, local

import numpy as np
from numpy.typing import NDArray

from photonpano.files.paths import Location, Url
from photonpano.reading.files import OpenFiles
from photonpano.reading.sources import BinarySource, FrameLayout
from photonpano.values import FrameSpan

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
