"""Time of each frame, frames without light, and frames where the image jumps: frames may be repeated, or missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import corners, inverse, transform_points
from photonpano.values import BoolArray, FloatArray, FrameSpan, Group

# Frames of the shortest part of a group that is kept beside a cut.
_SHORTEST_PART = 4


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """A place where the image jumps from one frame to the next."""

    frame: int  # the first frame after the jump
    shift_px: FloatArray  # (2,) by how much more than before and after it the image moves there, x and y in px of a frame
    sigmas: float  # its size in standard deviations of what the image does nearby
    # frames around it that show nothing, so that the jump may lie anywhere among them; None where all have light
    dark: FrameSpan | None = None

    def along(self, trajectory: Trajectory, frame_shape: tuple[int, int]) -> Cut:
        """Return this cut with the shift that a trajectory has there, beyond the motion from frame to frame beside it."""
        homographies = trajectory.at(self.frame + np.arange(-2, 2))
        middle = corners(frame_shape).mean(axis=0)
        before, here, after = transform_points(inverse(homographies[1:]) @ homographies[:-1], middle[None])[:, 0] - middle
        return replace(self, shift_px=here - (before + after) / 2)

    @property
    def size_px(self) -> float:
        """Length of the shift, in px."""
        return float(np.linalg.norm(self.shift_px))

    @property
    def bounds(self) -> tuple[int, ...]:
        """Frames at which groups are divided."""
        return (self.frame,) if self.dark is None else (self.dark.start, self.frame, self.dark.stop)


@dataclass(frozen=True, slots=True, eq=False)
class Timeline:
    """Time of each frame, and frames where the image jumps."""

    taken: FloatArray  # (T,) the time of each frame, in frame periods of the camera: it stands still where a frame is repeated
    cuts: tuple[Cut, ...] = ()  # where the image jumps, in order
    dark: tuple[FrameSpan, ...] = ()  # frames without light, in order: no group holds them, and they are not located
    shots: tuple[FrameSpan, ...] = ()  # parts that no motion ties together, in order; groups are of the longest

    @classmethod
    def regular(cls, n_frames: int) -> Timeline:
        """Return that of a capture without missing or repeated frames."""
        return cls(np.arange(n_frames, dtype=np.float64))

    @classmethod
    def with_repeats(cls, repeated: BoolArray, dark: tuple[FrameSpan, ...] = ()) -> Timeline:
        """Return that of a capture without missing frames; (T,) True for frames that are copies of the frame before."""
        return cls(np.cumsum(~repeated).astype(np.float64) - 1.0, dark=dark)

    @property
    def copies(self) -> BoolArray | None:
        """(T,) True for frames that are copies of the one before; None if there are none."""
        copies = np.diff(self.taken, prepend=-1.0) == 0
        return copies if copies.any() else None

    @property
    def shown(self) -> BoolArray:
        """(T,) whether each frame shows the scene of the panorama, neither darkness nor another shot."""
        frames = np.arange(len(self.taken))
        shown = (self.shot.start <= frames) & (frames < self.shot.stop)
        for span in self.dark:
            shown[span.start : span.stop] = False
        return shown

    @property
    def shot(self) -> FrameSpan:
        """The frames of the longest shot, the first of several; all if there is a single one."""
        return max(self.shots, key=len, default=FrameSpan(0, len(self.taken)))

    @property
    def n_repeated(self) -> int:
        """How many frames are copies of the one before."""
        return int(len(self.taken) - 1 - self.taken[-1])

    def cut_at(self, cuts: Sequence[Cut]) -> Timeline:
        """Return this timeline with other cuts."""
        return replace(self, cuts=tuple(cuts))

    def in_shots(self, shots: Sequence[FrameSpan]) -> Timeline:
        """Return this timeline without cuts, in shots of which the longest is located."""
        return replace(self, cuts=(), shots=tuple(shots))

    def parts(self, groups: Sequence[Group]) -> tuple[Group, ...]:
        """Divide groups at the cuts and the frames without light; leave out those that consist mostly of repeated frames.

        Parts shorter than 4 frames are left out, and those that were taken at the same time as another one. If nothing else is
        left, groups of repeated frames are.
        """
        found: dict[float, Group] = {}
        for group in groups:
            for span in self._divided(group.span):
                whole = span == group.span
                if self._is_left_out(span) or (not whole and len(span) < _SHORTEST_PART):
                    continue
                if 2 * (self.taken[span.stop - 1] - self.taken[span.start] + 1) < len(span):
                    continue
                part = group if whole else Group(span, span.centre)
                found.setdefault(float(self.times(part.reference)), part)
        found = found or {float(self.times(group.reference)): group for group in reversed(groups)}
        return tuple(found[time] for time in sorted(found))

    def fit(self, interpolate: Callable[[slice, FloatArray], Trajectory], instants: FloatArray) -> Trajectory:
        """Interpolate each piece between two cuts by itself; `interpolate` fits some of the (N,) knots, given their times."""
        pieces, times = self.knot_pieces(instants), self.times(instants)
        # A piece without a knot goes on as the nearest one.
        known = [number for number, piece in enumerate(pieces) if piece.start < piece.stop]
        fitted = {number: interpolate(pieces[number], times[pieces[number]]) for number in known}
        nearest = [min(known, key=lambda each: abs(each - number)) for number in range(len(pieces))]
        return PiecewiseTrajectory(self, [fitted[number] for number in nearest])

    def shift_between(self, earlier: float, later: float) -> FloatArray:
        """Return how far the image jumps between two instants: (2,) in px."""
        shifts = [cut.shift_px for cut in self.cuts if earlier < cut.frame - 0.5 <= later]
        return np.sum(shifts, axis=0) if shifts else np.zeros(2)

    def unknown_px(self, instants: FloatArray) -> FloatArray:
        """Return by how far N instants may lie on the other side of a jump in the dark, in px: (N,)."""
        unknown = np.zeros(len(instants))
        for cut in self.cuts:
            if cut.dark is not None:
                unknown[(cut.dark.start <= instants) & (instants < cut.dark.stop)] = cut.size_px
        return unknown

    def piece_of(self, instants: ArrayLike) -> NDArray[np.integer]:
        """Return the number of the piece that each of N instants, in frames, lies in: (N,), 0 before the first cut.

        Where frames are dark for long, the camera may move as it likes: the motion before and after them is of two pieces.
        """
        return np.searchsorted(self._bounds, instants, side="right")

    def knot_pieces(self, instants: FloatArray) -> list[slice]:
        """Return which of N knots lie in each piece; their instants are in order."""
        bounds = np.searchsorted(self.piece_of(instants), np.arange(len(self._bounds) + 2))
        return [slice(start, stop) for start, stop in pairwise(bounds.tolist())]

    def times(self, instants: ArrayLike) -> FloatArray:
        """Return when N instants, in frames, were taken, in frame periods: (N,). Beyond the capture, time goes on."""
        at, last = np.asarray(instants, dtype=np.float64), len(self.taken) - 1
        inside = np.clip(at, 0, last)
        # Not by np.interp, which would look at all frames at each call, to check that their numbers are in order.
        before = np.minimum(inside.astype(np.intp), max(last - 1, 0))
        start, stop = self.taken[before], self.taken[np.minimum(before + 1, last)]
        return np.asarray((stop - start) * (inside - before) + start + np.minimum(at, 0) + np.maximum(at - last, 0))

    @property
    def _bounds(self) -> list[float]:
        dark = [each.centre for each in self.dark if each.start > 0 and each.stop < len(self.taken)]
        return sorted({*dark, *(cut.frame - 0.5 for cut in self.cuts)})

    def is_dark_between(self, earlier: float, later: float) -> bool:
        """Return whether frames without light lie between two instants, after which the image may be anywhere."""
        return any(earlier < each.start and each.stop <= later + 1 for each in self.dark)

    def _divided(self, span: FrameSpan) -> list[FrameSpan]:
        ends = [end for each in (*self.dark, *self.shots) for end in (each.start, each.stop)]
        bounds = {
            bound for bound in (*ends, *(each for cut in self.cuts for each in cut.bounds)) if span.start < bound < span.stop
        }
        return [FrameSpan(start, stop) for start, stop in pairwise([span.start, *sorted(bounds), span.stop])]

    def _is_left_out(self, span: FrameSpan) -> bool:
        if span.start < self.shot.start or span.stop > self.shot.stop:
            return True
        dark = [*self.dark, *(cut.dark for cut in self.cuts if cut.dark is not None)]
        return any(each.start <= span.start and span.stop <= each.stop for each in dark)


class PiecewiseTrajectory:
    """A trajectory that jumps at the cuts of a timeline, and stands still where frames are repeated."""

    def __init__(self, timeline: Timeline, pieces: Sequence[Trajectory]) -> None:
        """Take a trajectory for each piece of the timeline."""
        self._timeline, self._pieces = timeline, pieces

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        instants = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        piece_of, times = self._timeline.piece_of(instants), self._timeline.times(instants)
        found = np.empty((len(instants), 3, 3))
        for number in np.unique(piece_of):
            here = piece_of == number
            found[here] = self._pieces[number].at(times[here])
        return found
