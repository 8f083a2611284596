"""The merge step: virtual exposures of a level, made when they are asked for, so that no level is held in memory."""

from __future__ import annotations

from collections.abc import Sequence

from photonpano.errors import PluginError
from photonpano.motion.level import Level
from photonpano.protocols import Source, Trajectory
from photonpano.threads import Stopwatch
from photonpano.values import Group, VirtualExposure


def merge(
    level: Level, source: Source, groups: Sequence[Group], known: Trajectory | None, clock: Stopwatch
) -> VirtualExposures:
    """Merge the groups of a level along the motion known so far (paper, section 4, "Merge"), each when it is asked for.

    Args:
        level: the components of the level.
        source: the capture.
        groups: what is merged.
        known: the motion known so far; None at the first level.
        clock: is told the time that merging takes.
    """
    return VirtualExposures(level, source, groups, known, clock)


class VirtualExposures:
    """The virtual exposures of a level: `exposures[i]` merges group i along the motion known so far.

    Nothing is kept: an exposure that is asked for again is merged again. May be used from several threads.
    """

    def __init__(
        self, level: Level, source: Source, groups: Sequence[Group], known: Trajectory | None, clock: Stopwatch
    ) -> None:
        self._level = level
        self._source = source
        self._known = known
        self._clock = clock
        self.groups = groups
        self.frame_shape = source.info.frame_shape

    def __len__(self) -> int:
        return len(self.groups)

    def __getitem__(self, index: int) -> VirtualExposure:
        level = self._level
        with self._clock("merge"), level.attributing("merger"):
            exposure = level.merger.merge(self._source, self.groups[index], self._known, level.scale)
        if not isinstance(exposure, VirtualExposure):
            raise PluginError(
                f"{level.origins['merger']} broke its contract at level {level.number}: "
                f"expected a VirtualExposure, got {type(exposure).__name__}"
            )
        if exposure.scale != level.scale:
            raise PluginError(
                f"{level.origins['merger']} broke its contract at level {level.number}: "
                f"expected an exposure of scale {level.scale:g}, got {exposure.scale:g}"
            )
        return exposure
