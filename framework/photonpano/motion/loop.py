"""The loop of the paper (section 4): re-sample, merge, locate, interpolate, and again with denser groups."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from numpy.typing import ArrayLike

from photonpano.context import Context
from photonpano.errors import PluginError
from photonpano.geometry import inverse, normalised
from photonpano.motion.attribution import AttributedTrajectory
from photonpano.motion.graph import GraphOptions
from photonpano.motion.level import Level
from photonpano.motion.locate import LocatedLevel, locate
from photonpano.motion.merge import merge
from photonpano.motion.uncertainty import Uncertainty
from photonpano.protocols import Source, Trajectory
from photonpano.threads import Stopwatch
from photonpano.values import FloatArray, Group


@dataclass(frozen=True, slots=True, eq=False)
class LevelResult:
    """What one level found.

    Attributes:
        level: its components.
        groups: what was merged.
        located: pairs, motions, and where the exposures lie.
        trajectory: the motion known after the level; the reference frame's homography is the identity.
        uncertainty: how far it may be from the true one.
        seconds: time spent in each stage.
    """

    level: Level
    groups: tuple[Group, ...]
    located: LocatedLevel
    trajectory: Trajectory
    uncertainty: Uncertainty
    seconds: dict[str, float]

    @property
    def change_px(self) -> float | None:
        """How far the level moved the corners of the frames, on average, in px of a frame; None at the first."""
        return self.uncertainty.change_px

    @property
    def converged(self) -> bool:
        """Whether another level would change less than is known: the level changed the motion by less than its uncertainty."""
        return self.change_px is not None and self.change_px <= self.uncertainty.mean_px


def estimate_motion(
    source: Source,
    levels: Sequence[Level],
    graph: GraphOptions,
    reference: int,
    context: Context,
    until_converged: bool = False,
) -> list[LevelResult]:
    """Estimate the motion of a capture, level by level (paper, section 4).

    `merge` only plans the virtual exposures of a level. Each is merged when `locate` needs it, in the threads that also
    register pairs, and is released when its last pair is done, so that memory does not grow with the number of groups.

    Args:
        source: the capture.
        levels: the components of each level.
        graph: which pairs are registered, and what happens when exposures cannot be tied to the others.
        reference: the frame whose homography is the identity.
        context: threads, progress, and `on_level`, which is called with each result.
        until_converged: stop as soon as a level changes the motion by less than its own uncertainty.

    Raises:
        LocationError: too few exposures could be located.
        PluginError: a component failed in its own way, or broke its contract.
    """
    results: list[LevelResult] = []
    known: Trajectory | None = None
    for level in levels:
        clock = Stopwatch(context.threads)
        groups = resample(level, source.info.n_frames, clock)
        exposures = merge(level, source, groups, known, clock)
        located = locate(level, exposures, known, graph, clock, context)
        trajectory = interpolate(level, located, reference, clock)
        uncertainty = Uncertainty(located, trajectory, known, source.info.n_frames)
        results.append(LevelResult(level, groups, located, trajectory, uncertainty, clock.seconds))
        context.progress.note(_summary(results[-1]))
        context.on_level(results[-1])
        known = trajectory
        # A level at half size only prepares for one at full size.
        if until_converged and results[-1].converged and level.scale == levels[-1].scale:
            break
    return results


def resample(level: Level, n_frames: int, clock: Stopwatch) -> tuple[Group, ...]:
    """Choose the groups of a level (paper, section 4, "Re-sample").

    Raises:
        PluginError: they are no groups, not in order, or lie outside the capture.
    """
    with clock("resample"), level.attributing("resampler"):
        groups = tuple(level.resampler.groups(n_frames, level.number))
    who = f"{level.origins['resampler']} broke its contract at level {level.number}"
    for group in groups:
        if not isinstance(group, Group):
            raise PluginError(f"{who}: expected groups, got {group!r:.60}")
    instants = [group.reference for group in groups]
    if not groups or any(later <= earlier for earlier, later in pairwise(instants)):
        raise PluginError(f"{who}: expected at least one group, in order, each instant once; got the instants {instants}")
    if beyond := [str(group) for group in groups if group.span.stop > n_frames]:
        raise PluginError(f"{who}: the capture has {n_frames} frames (0 to {n_frames - 1}), got a group of {beyond[0]}")
    return groups


def interpolate(level: Level, located: LocatedLevel, reference: int, clock: Stopwatch) -> Trajectory:
    """Turn the located instants into a homography for every frame (paper, section 4, "Interpolate")."""
    with clock("interpolate"), level.attributing("interpolator"):
        free = level.interpolator.fit(located.instants, located.homographies, located.information)
        return ReferencedTrajectory(AttributedTrajectory(free, level.origins["interpolator"], level.number), reference)


class ReferencedTrajectory:
    """A trajectory whose homography at the reference frame is the identity.

    Convention:
        `at` maps a frame's pixels to the pixels of the reference frame; h33 = 1.
    """

    def __init__(self, free: Trajectory, reference: int) -> None:
        self._free = free
        self._to_reference = inverse(free.at([reference])[0])

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        return normalised(self._to_reference @ self._free.at(frame_indices))


def _summary(result: LevelResult) -> str:
    located = result.located
    text = f"level {result.level.number}: {located.n_located} of {len(result.groups)} exposures located"
    if located.failures:
        text += f", {len(located.failures)} of {len(located.edges)} pairs failed"
    return text if result.change_px is None else f"{text}, the motion changed by {result.change_px:.2f} px"
