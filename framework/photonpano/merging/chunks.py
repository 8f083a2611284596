"""Chunks: runs of frames within which the motion stays below a tolerance, so that one warp serves the whole run."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import BLOCK_FRAMES, steps_px
from photonpano.values import Counts, FrameSpan, Homography


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Frames that are summed before they are warped."""

    span: FrameSpan  # the frames
    # (3, 3), pixels of the frame at the centre of the span to pixels of the reference plane: that instant of the trajectory.
    # The identity where no motion is known.
    homography: Homography


def chunks_of(
    span: FrameSpan, trajectory: Trajectory, frame_shape: tuple[int, int], tolerance_px: float, cuts: ArrayLike = ()
) -> tuple[Chunk, ...]:
    """Split a span so that no corner of a frame moves further than `tolerance_px` within a chunk.

    Args:
        span: the frames to split.
        trajectory: the motion along which they are summed.
        frame_shape: (height, width) of a frame.
        tolerance_px: length of a corner's path, in pixels of a frame, that one warp may ignore. A chunk is warped at its
            centre instant, so that a photon is misplaced by about half of it at most.
        cuts: instants that no chunk contains.
    """
    blocks = [FrameSpan(block.start, min(block.stop + 1, span.stop)) for block in span.blocks(BLOCK_FRAMES)]
    # The motion of each frame in pixels of the frame before.
    steps = [steps_px(trajectory.at(np.arange(block.start, block.stop)), frame_shape).max(axis=-1) for block in blocks]
    path_px = np.cumsum(np.concatenate([[0.0], *steps]))
    starts = span.start + np.flatnonzero(np.diff(np.floor(path_px / tolerance_px), prepend=-1.0))
    inside = np.ceil(np.asarray(cuts, float)).astype(int)
    starts = np.union1d(starts, inside[(span.start < inside) & (inside < span.stop)])
    stops = np.append(starts[1:], span.stop)
    spans = [FrameSpan(start, stop) for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    centres = trajectory.at([chunk.centre for chunk in spans])
    return tuple(Chunk(chunk, homography) for chunk, homography in zip(spans, centres, strict=True))


def clipped(chunks: Sequence[Chunk], span: FrameSpan, trajectory: Trajectory) -> tuple[Chunk, ...]:
    """Return the parts of chunks that lie in a span.

    Chunks inside the span are returned as they are, so that overlapping spans share their sums: see `CountsCache`.

    Args:
        chunks: in order, as `chunks_of` returns them.
        span: the frames to keep.
        trajectory: the motion along which they are summed.
    """
    first = bisect_right(chunks, span.start, key=lambda chunk: chunk.span.stop)
    last = bisect_left(chunks, span.stop, key=lambda chunk: chunk.span.start)
    inside = list(chunks[first:last])
    for end in {0, len(inside) - 1}:
        whole = inside[end].span
        part = FrameSpan(max(whole.start, span.start), min(whole.stop, span.stop))
        if part != whole:
            inside[end] = Chunk(part, trajectory.at([part.centre])[0])
    return tuple(inside)


class CountsCache:
    """Caches the sums of frames that overlapping groups share; drops the least recently used. Safe from several threads."""

    def __init__(self, source: Source, capacity_bytes: int) -> None:
        self._capture = capture_of(source)
        height, width = source.info.frame_shape
        self._max_sums = max(1, capacity_bytes // (4 * height * width))
        self._sums: OrderedDict[FrameSpan, Future[Counts]] = OrderedDict()
        self._lock = Lock()

    def __call__(self, span: FrameSpan) -> Counts:
        """Return the sum of the frames of a span, read-only: see `Capture.chunk`.

        If several threads ask for one span at once, the first computes it and the others wait.
        """
        with self._lock:
            cached = self._sums.get(span)
            if cached is not None:
                self._sums.move_to_end(span)
            else:
                future = self._sums[span] = Future()
                while len(self._sums) > self._max_sums:
                    self._sums.popitem(last=False)
        if cached is not None:
            return cached.result()
        try:
            counts = self._capture.chunk(span)
            counts.flags.writeable = False
        except BaseException as error:
            future.set_exception(error)
            raise
        future.set_result(counts)
        return counts
