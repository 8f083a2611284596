"""The components of one level of the loop, the scale of its exposures, and the merge step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NewType

import numpy as np

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Interpolator, Locator, Merger, Resampler, Source, Trajectory
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import Camera, inverse, rescaled, scaled_ahead
from photonpano.motion.timeline import Timeline
from photonpano.values import Decision, DecisionValue, FloatArray, FrameSpan, Group, Located, VirtualExposure

_SAMPLED = 8  # instants of a group at which its motion is looked at

# In pixels of frames, as in the motion graph and in trajectories.
FrameHomography = NewType("FrameHomography", FloatArray)
# In pixels of a level's exposures, as locators have it.
ExposureHomography = NewType("ExposureHomography", FloatArray)


class Recorder:
    """Records decisions: what a `StageContext` offers to components as `decide`.

    A component that is sent to another process takes its recorder along. There it collects decisions until a task returns them.
    """

    def __init__(self, decisions: list[Decision] | None = None) -> None:
        """Take the list of a run that receives decisions; None in another process."""
        self.decisions, self._waiting = decisions, list[Decision]()

    def __call__(self, what: str, value: DecisionValue, reason: str) -> None:
        """Record a decision; a `TypeError` if its value is no plain one."""
        if not isinstance(value, bool | int | float | str):
            raise TypeError(f"the value of a decision is a number, a text, true or false; {what} is a {type(value).__name__}")
        self.add(Decision(what, value, reason))

    def add(self, decision: Decision) -> None:
        """Record a decision that was taken elsewhere."""
        (self._waiting if self.decisions is None else self.decisions).append(decision)

    def taken(self) -> tuple[Decision, ...]:
        """Return the decisions that another process has collected, once; in that of the run, there are none."""
        waiting, self._waiting = self._waiting, []
        return tuple(waiting)

    def __reduce__(self) -> tuple[Callable[[], Recorder], tuple[()]]:
        return Recorder, ()


@dataclass(frozen=True, slots=True)
class NamedLocator:
    """A locator of a level."""

    name: str  # as in the spec; the second of a level with the same name is numbered, such as "opencv-sift 2"
    component: Locator


@dataclass(frozen=True, slots=True)
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

    def __reduce__(self) -> tuple[Any, ...]:
        """Leave out what only the process of the loop needs: the resampler and the interpolator."""
        components = None, self.merger, self.locators, None
        return Level, (self.number, self.scale, *components, self.recorder, self.handles_movers)

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


@dataclass(frozen=True, slots=True, eq=False)
class VirtualExposures:
    """The virtual exposures of a level, planned. May be used from several threads."""

    level: Level
    source: Source
    groups: Sequence[Group]  # the frames of each exposure
    previous: Trajectory | None  # the motion known so far; None at the first level
    clock: Stopwatch  # adds up the time that merging takes
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
