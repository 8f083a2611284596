"""Sums of frames that several groups ask for, made once."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future
from threading import Lock

from photonpano.protocols import Source
from photonpano.values import Counts, FrameSpan


class SharedCounts:
    """Remembers sums of a capture, those asked for last, up to a number of bytes. May be used from several threads."""

    def __init__(self, source: Source, capacity_bytes: int) -> None:
        self._source = source
        height, width = source.info.frame_shape
        self._most = max(1, capacity_bytes // (4 * height * width))
        self._sums: OrderedDict[FrameSpan, Future[Counts]] = OrderedDict()
        self._lock = Lock()

    def __call__(self, span: FrameSpan) -> Counts:
        """Return the sum of the frames of a span, (H, W) uint32, which is not to be written to.

        Whoever asks first makes it; others wait.
        """
        with self._lock:
            known = self._sums.get(span)
            if known is not None:
                self._sums.move_to_end(span)
            else:
                mine = self._sums[span] = Future()
                while len(self._sums) > self._most:
                    self._sums.popitem(last=False)
        if known is not None:
            return known.result()
        try:
            counts = self._source.counts(span)
            counts.flags.writeable = False
        except BaseException as error:
            mine.set_exception(error)
            raise
        mine.set_result(counts)
        return counts
