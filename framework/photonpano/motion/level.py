"""Time as a level sees it: frames without light and jumps, the components of a level, its exposures, and the merge step."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from operator import attrgetter
from typing import NewType, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Interpolator, Locator, Merger, Resampler, Source, Trajectory
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import Camera, corners, inverse, rescaled, scaled_ahead, transform_points
from photonpano.values import BoolArray, Decision, DecisionValue, FloatArray, FrameSpan, Group, Located, VirtualExposure

# Frames of the shortest part of a group that is kept beside a cut.
_SHORTEST_PART = 4
SHORTEST_DARK = 32  # frames without light in a row, between which the camera may move as it likes
_SAMPLED = 8  # instants of a group at which its motion is looked at
# In pixels of frames, as in the motion graph and in trajectories.
FrameHomography = NewType("FrameHomography", FloatArray)
# In pixels of a level's exposures, as locators have it.
ExposureHomography = NewType("ExposureHomography", FloatArray)


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
    dark: tuple[FrameSpan, ...] = ()  # frames without light for long, in order: no group holds them, and none is located
    unlit: tuple[FrameSpan, ...] = ()  # frames without light for so short a time that the motion goes on: they count in no sum
    shots: tuple[FrameSpan, ...] = ()  # parts that no motion ties together, in order; groups are of the longest

    @classmethod
    def regular(cls, n_frames: int) -> Timeline:
        """Return that of a capture without missing or repeated frames."""
        return cls(np.arange(n_frames, dtype=np.float64))

    @classmethod
    def with_repeats(cls, repeated: BoolArray, unlit: tuple[FrameSpan, ...] = ()) -> Timeline:
        """Return that of a capture without missing frames; (T,) True for frames that are copies of the frame before.

        `unlit` are all spans of frames without light, in order.
        """
        dark = tuple(span for span in unlit if len(span) >= SHORTEST_DARK)
        brief = tuple(span for span in unlit if len(span) < SHORTEST_DARK)
        return cls(np.cumsum(~repeated).astype(np.float64) - 1.0, dark=dark, unlit=brief)

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
        for span in (*self.dark, *self.unlit):
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
        before = self.unlit[max(bisect_right(self.unlit, span.start, key=attrgetter("start")) - 1, 0) :][:1]
        dark = [*self.dark, *before, *(cut.dark for cut in self.cuts if cut.dark is not None)]
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


class Recorder:
    """Records decisions: what a `StageContext` offers to components as `decide`.

    A component that is sent to another process takes a copy along: tasks return what it has recorded there.
    """

    def __init__(self, decisions: list[Decision] | None = None) -> None:
        """Take the list of a run that receives decisions."""
        self.decisions = list[Decision]() if decisions is None else decisions

    def __call__(self, what: str, value: DecisionValue, reason: str) -> None:
        """Record a decision; a `TypeError` if its value is no plain one."""
        if not isinstance(value, bool | int | float | str):
            raise TypeError(f"the value of a decision is a number, a text, true or false; {what} is a {type(value).__name__}")
        self.decisions.append(Decision(what, value, reason))


@dataclass(frozen=True, slots=True)
class NamedLocator:
    """A locator of a level."""

    name: str  # as in the spec; the second of a level with the same name is numbered, such as "opencv-sift 2"
    component: Locator


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """The components of one level, built: see `photonpano.contracts.attribution`."""

    number: int  # from 1
    scale: float  # pixels of the level's exposures per pixel of a frame
    resampler: Resampler
    merger: Merger
    locators: tuple[NamedLocator, ...]  # at least one; a pair that one of them does not locate is passed to the next
    interpolator: Interpolator
    recorder: Recorder = field(default_factory=Recorder)  # records what they decide
    handles_movers: bool = False  # whether the merger does: see `MergerContribution`

    def of_tasks(self) -> Level:
        """Return the level without what only the loop needs, and need not travel: the resampler and the interpolator."""
        return replace(self, resampler=cast("Resampler", None), interpolator=cast("Interpolator", None))

    def turning(self, camera: Camera | None) -> Level:
        """Return the level for a camera that only turns, which locators use if they can; None if it is not known."""
        if camera is None:
            return self
        matrix, locators = camera.scaled(self.scale).matrix, []
        for locator in self.locators:
            if hasattr(locator.component, "turning"):
                locator = replace(locator, component=locator.component.turning(matrix))
            locators.append(locator)
        return replace(self, locators=tuple(locators))

    def in_exposure_px(self, homography: FrameHomography) -> ExposureHomography:
        """Convert a homography from pixels of frames to pixels of the level's exposures."""
        return ExposureHomography(rescaled(homography, self.scale))

    def in_frame_px(self, motion: Located) -> Located:
        """Convert a motion from pixels of the level's exposures to pixels of frames."""
        homography = rescaled(motion.homography, 1 / self.scale)
        information = motion.information
        if information is not None:
            # To first order, the unit of length matters to translation (p5, p6) and perspective (p7, p8) alone.
            units = np.array([1, 1, 1, 1, self.scale, self.scale, 1 / self.scale, 1 / self.scale])
            information = information * np.outer(units, units)
        residual_px = None if motion.residual_px is None else motion.residual_px / self.scale
        patches = None if motion.patches is None else motion.patches.rescaled(1 / self.scale)
        return replace(motion, homography=homography, information=information, residual_px=residual_px, patches=patches)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class VirtualExposures:
    """The virtual exposures of a level, planned. May be used from several threads."""

    level: Level
    source: Source
    groups: Sequence[Group]  # the frames of each exposure
    previous: Trajectory | None  # the motion known so far; None at the first level
    clock: Stopwatch  # adds up the time of the level
    timeline: Timeline | None = None  # where the image jumps; None if it is not known to
    start: Trajectory | None = None  # along which exposures are merged while no motion is known; None if nothing shows it
    known: FrameSpan | None = None  # frames in which the motion known so far was located; None if it is nowhere extrapolated

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.source.info.frame_shape

    def is_foreseen(self, index: int) -> bool:
        """Return whether the motion of an exposure, given by its index, is known so far and not extrapolated."""
        return self.known is None or self.known.start <= self.groups[index].reference < self.known.stop

    def off_centre(self, motion: Trajectory) -> FloatArray:
        """Return how exposures merged along another motion are displaced by that: (N, 3, 3), frame pixels to pixels as merged.

        It is the mean over the frames of each group, to first order.
        """
        shares = (np.arange(_SAMPLED) + 0.5) / _SAMPLED
        inside = [[*(each.span.start + shares * len(each.span) - 0.5), each.reference] for each in self.groups]
        instants = np.array(inside)
        along, shape = self.previous or self.start, (len(instants), _SAMPLED + 1, 3, 3)
        true = motion.at(instants.ravel()).reshape(shape)
        back = inverse(true[:, :-1]) @ true[:, -1:]
        if along is not None:
            assumed = along.at(instants.ravel()).reshape(shape)
            back = inverse(assumed[:, -1:]) @ assumed[:, :-1] @ back
        return np.asarray(scaled_ahead(back).mean(axis=1))

    def merged(self, index: int, clock: Stopwatch | None = None) -> VirtualExposure:
        """Merge a group, given by its index, along the motion known so far; a second call merges it again.

        `clock` adds up the time, by default that of the level.

        Raises:
            PluginError: the merger failed, or returned anything but an exposure of the group at the level's scale.
        """
        level, group = self.level, self.groups[index]
        source = self.source if level.handles_movers else capture_of(self.source).masked_in(group.span)
        with (clock or self.clock)("merge"):
            return level.merger.merge(source, group, self.previous or self.start, level.scale)
