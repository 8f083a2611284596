"""Pieces of a capture that take long to fetch, as over a network: kept for a while, and fetched ahead."""

from __future__ import annotations

from bisect import bisect_right
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from photonpano.values import FrameSpan

_KEPT = 32  # pieces kept, the latest ones
_AHEAD = 6  # pieces fetched ahead of the one that is read
_FETCHED_AT_ONCE = 8
_ENDS = 64  # ends of spans remembered: a span that begins at one of them continues it
_SMALL = 4  # a span below 1/4 of a piece is fetched alone, unless it continues another

Fetch = Callable[[FrameSpan], NDArray[np.uint8]]


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
