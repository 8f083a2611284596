"""Chunks: runs of frames within which the motion stays under a fraction of a pixel, so that one warp serves them all."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonpano.geometry import corner_displacements, inverse
from photonpano.protocols import Trajectory
from photonpano.values import FloatArray, FrameSpan, Homography

_AT_ONCE = 8192
"""So many frames are looked at together, which bounds the memory that it takes."""


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Frames that are summed before they are warped.

    Attributes:
        span: the frames.
        homography: (3, 3), pixels of the frame at the centre of the span to pixels of the reference plane.
    """

    span: FrameSpan
    homography: Homography


def chunks_of(span: FrameSpan, trajectory: Trajectory, frame_shape: tuple[int, int], tolerance_px: float) -> tuple[Chunk, ...]:
    """Split a span so that no corner of a frame moves further than `tolerance_px` within a chunk.

    Args:
        span: the frames to split.
        trajectory: the motion along which they are summed.
        frame_shape: (height, width) of a frame.
        tolerance_px: length of the way of a corner, in pixels of a frame, that one warp may ignore. A chunk is warped at its
            centre instant, so that no photon is misplaced by more than about half of it.
    """
    parts = range(span.start, span.stop - 1, _AT_ONCE)
    steps = [_steps_px(trajectory, start, min(start + _AT_ONCE, span.stop - 1), frame_shape) for start in parts]
    way = np.cumsum(np.concatenate([[0.0], *steps]))
    starts = span.start + np.flatnonzero(np.diff(np.floor(way / tolerance_px), prepend=-1.0))
    stops = np.append(starts[1:], span.stop)
    spans = [FrameSpan(start, stop) for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    centres = trajectory.at([chunk.centre for chunk in spans])
    return tuple(Chunk(chunk, homography) for chunk, homography in zip(spans, centres, strict=True))


def _steps_px(trajectory: Trajectory, start: int, stop: int, frame_shape: tuple[int, int]) -> FloatArray:
    """Return how far the corners of the frames from start to stop move to the next frame, at most: (stop - start,)."""
    homographies = trajectory.at(np.arange(start, stop + 1))
    # Seen from frame t, in its own pixels: how far frame t + 1 has moved.
    steps = inverse(homographies[:-1]) @ homographies[1:]
    return np.asarray(corner_displacements(steps, np.eye(3), frame_shape).max(axis=-1))


def clipped(chunks: Sequence[Chunk], span: FrameSpan, trajectory: Trajectory) -> tuple[Chunk, ...]:
    """Return the parts of chunks that lie in a span. Those inside are the same for every span, so that sums can be shared.

    Args:
        chunks: in order, as `chunks_of` gives them.
        span: the frames that are wanted.
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
