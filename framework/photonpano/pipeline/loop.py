"""The loop of the paper (section 4): re-sample, merge, locate, interpolate, and again with denser groups."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from photonpano.errors import PluginError
from photonpano.pipeline.locate import locate
from photonpano.pipeline.merge import merge
from photonpano.pipeline.named import NamedTrajectory
from photonpano.pipeline.observers import NOBODY
from photonpano.pipeline.stopwatch import Stopwatch
from photonpano.pipeline.trajectory import ReferencedTrajectory
from photonpano.pipeline.uncertainty import Uncertainty
from photonpano.values import Group

if TYPE_CHECKING:
    from collections.abc import Sequence

    from photonpano.pipeline.components import Level
    from photonpano.pipeline.locate import LocatedLevel
    from photonpano.pipeline.observers import Observers
    from photonpano.pipeline.progress import Progress
    from photonpano.protocols import Source, Trajectory
    from photonpano.spec.settings import GraphSettings


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
    graph: GraphSettings,
    reference: int,
    threads: int,
    progress: Progress,
    until_converged: bool = False,
    observers: Observers = NOBODY,
) -> list[LevelResult]:
    """Estimate the motion of a capture, level by level.

    Args:
        source: the capture.
        levels: the components of each level.
        graph: which pairs are registered, and what happens when exposures cannot be tied to the others.
        reference: the frame whose homography is the identity.
        threads: how many exposures are worked on at once; the result does not depend on it.
        progress: is told of the stages.
        until_converged: stop as soon as a level changes the motion by less than its own uncertainty.
        observers: are told of the stages of a level when it is done.

    Raises:
        LocationError: too few exposures could be located.
        PluginError: a component failed in its own way, or broke its contract.
    """
    results: list[LevelResult] = []
    known: Trajectory | None = None
    for level in levels:
        clock = Stopwatch(threads)
        groups = resample(level, source.info.n_frames, clock)
        exposures = merge(level, source, groups, known, clock)
        located = locate(level, exposures, known, graph, threads, clock, progress)
        trajectory = interpolate(level, located, reference, clock)
        uncertainty = Uncertainty(located, trajectory, known, source.info.n_frames)
        results.append(LevelResult(level, groups, located, trajectory, uncertainty, clock.seconds))
        progress.note(_summary(results[-1]))
        observers.level_finished(results[-1])
        known = trajectory
        # What was located at half size only prepares for what is not.
        if until_converged and results[-1].converged and level.scale == levels[-1].scale:
            break
    return results


def resample(level: Level, n_frames: int, clock: Stopwatch) -> tuple[Group, ...]:
    """Choose the groups of a level (paper, section 4, "Re-sample").

    Raises:
        PluginError: they are no groups, not in order, or lie outside the capture.
    """
    with clock("resample"), level.blaming("resampler"):
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
    with clock("interpolate"), level.blaming("interpolator"):
        free = level.interpolator.fit(located.instants, located.homographies, located.information)
        return ReferencedTrajectory(NamedTrajectory(free, level), reference)


def _summary(result: LevelResult) -> str:
    located = result.located
    text = f"level {result.level.number}: {located.n_located} of {len(result.groups)} exposures located"
    if located.failures:
        text += f", {len(located.failures)} of {len(located.edges)} pairs failed"
    return text if result.change_px is None else f"{text}, the motion changed by {result.change_px:.2f} px"
