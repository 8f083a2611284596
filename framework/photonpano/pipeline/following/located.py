"""Locate a growing capture: the first level of the loop, on one window of frames after the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.capture import part_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.execution.threads import Stopwatch
from photonpano.motion.level import Level
from photonpano.motion.loop import resample
from photonpano.motion.timeline import Timeline
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.state import State
from photonpano.specs.plan import Plan
from photonpano.values import FrameSpan, Homography

LEAST_FRAMES = {"binary": 256, "intensity": 16}  # minimum number of frames for the first group size
_MOST_GROUPS = 8  # maximum number of groups in a window, reached if frames come faster than they are located


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Frames that were located in one call of the loop."""

    source: Source  # the frames, as a capture of their own; those before `new` belong to the window before, too
    new: FrameSpan  # those that no window before had
    trajectory: Trajectory  # of the source, to the frame that both windows have in common
    joins: bool  # whether it continues the window before; False for the first one, and after frames that could not be located
    to_next: Homography  # the homography of the frame that it has in common with the next window


class LocatedSoFar:
    """Runs the first level of a plan on one window of the capture after the other.

    Each window begins with the last exposure of the one before that was located, which ties both.

    Attributes:
        n_frames: frames that were located, or given up.
        problem: why the last frames could not be located; empty if they were.
    """

    def __init__(self, plan: Plan, context: Context) -> None:
        self.n_frames, self.problem = 0, ""
        self._plan, self._context = plan, context
        self._level: Level | None = None
        self._built_at = 0
        self._start, self._tie = 0, 0
        self._tried = 0
        self._joins = False

    def next_window(self, source: Source, *, last: bool = False) -> Window | None:
        """Locate the next frames of `source`, which holds all that have arrived: a few groups of them.

        None if there are no new groups yet, or they could not be located: see `problem`. With `last`, it does not wait for
        more.
        """
        level, available = self._level_for(source, last), source.info.n_frames - self._start
        length = None if level is None else _group_length(level, source.info.n_frames)
        if level is None or length is None:
            return None
        n_groups = min(available // length, _MOST_GROUPS)
        stop = self._start + n_groups * length
        if stop <= max(self.n_frames, self._tried) or n_groups < 2:
            return None
        self._tried = stop
        part = part_of(source, FrameSpan(self._start, stop))
        try:
            state = State(
                self._plan, part, self._context, self._tie - self._start, (level,), Timeline.regular(len(part.info.span))
            )
            [result] = state.located([level], None).results
        except LocationError as error:
            self.problem = str(error)
            if n_groups == _MOST_GROUPS or last:
                self._begin_anew(stop - length, stop)
            return None
        found = np.flatnonzero(result.located.solution.located)
        if len(found) < 2 or not (last_located := int(found[-1])):
            self._begin_anew(stop - length, stop)
            return None
        self.problem = ""
        group = result.groups[last_located]
        tie = round(group.reference)
        new = FrameSpan(self.n_frames - self._start, stop - self._start)
        window = Window(part, new, result.trajectory, self._joins, result.trajectory.at([tie])[0])
        self.n_frames, self._tie, self._joins = stop, self._start + tie, True
        self._start += group.span.start
        return window

    def _begin_anew(self, start: int, stop: int) -> None:
        """Give up the frames before `stop`."""
        self.n_frames, self._start, self._tie, self._joins = stop, start, (start + stop) // 2, False

    def _level_for(self, source: Source, last: bool) -> Level | None:
        """Return the first level. It may choose a group size: it is built again when twice as many frames are there."""
        n_frames = source.info.n_frames
        if n_frames < LEAST_FRAMES[source.info.kind] and not last:
            return None
        if self._level is None or n_frames >= 2 * self._built_at:
            self._level, self._built_at = build_levels(self._plan, source, [])[0], n_frames
        return self._level


def _group_length(level: Level, n_frames: int) -> int | None:
    """Return the length of a group in frames; None if the capture is still shorter than one."""
    try:
        groups = resample(level, n_frames, Stopwatch(1))
    except InputError:
        return None
    return int(np.median([len(group.span) for group in groups]))
