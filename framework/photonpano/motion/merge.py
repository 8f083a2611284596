"""The merge step: plan the virtual exposures of a level; each is merged when it is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonpano.contracts.loop import EXPOSURE, Asked
from photonpano.motion.level import Level
from photonpano.motion.timeline import Timeline
from photonpano.protocols import Source, Trajectory
from photonpano.threads import Stopwatch
from photonpano.values import FloatArray, Group, VirtualExposure


@dataclass(frozen=True, slots=True, eq=False)
class VirtualExposures:
    """The virtual exposures of a level, planned. May be used from several threads."""

    level: Level
    source: Source
    groups: Sequence[Group]  # the frames of each exposure
    previous: Trajectory | None  # the motion known so far; None at the first level
    clock: Stopwatch  # adds up the time that merging takes
    timeline: Timeline | None = None  # where the image jumps; None if it is not known to

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Height and width of a frame."""
        return self.source.info.frame_shape

    def previous_homographies(self) -> FloatArray | None:
        """Return the motion known so far at every frame of the capture: (T, 3, 3); None at the first level."""
        return None if self.previous is None else self.previous.at(np.arange(self.source.info.n_frames))

    def merged(self, index: int, clock: Stopwatch | None = None) -> VirtualExposure:
        """Merge a group, given by its index, along the motion known so far; a second call merges it again.

        `clock` adds up the time, by default that of the level.

        Raises:
            PluginError: the merger failed, or returned anything but an exposure of the group at the level's scale.
        """
        level = self.level
        with (clock or self.clock)("merge"), level.attributing("merger"):
            exposure = level.merger.merge(self.source, self.groups[index], self.previous, level.scale)
            return EXPOSURE.require(exposure, Asked(self.groups[index], level.scale, self.frame_shape))


def merge(
    level: Level,
    source: Source,
    groups: Sequence[Group],
    previous: Trajectory | None,
    clock: Stopwatch,
    timeline: Timeline | None = None,
) -> VirtualExposures:
    """Plan the virtual exposures of a level: its groups, merged along the motion known so far (paper, section 4, "Merge")."""
    return VirtualExposures(level, source, groups, previous, clock, timeline)
