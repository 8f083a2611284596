"""How far a trajectory may be from the true one, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry import align_planes, corner_displacements, inverse
from photonpano.motion.locate import LocatedLevel
from photonpano.protocols import Trajectory
from photonpano.values import FloatArray

_COMPARED = 1000
"""Two levels are compared at so many frames."""
_UNSETTLED = 0.25
"""The share of what a level still changed that is taken to be wrong after it: each level takes away three quarters or more."""
_BLURRED = 0.02
"""The share of the way within a group by which the first level errs, where nothing else is known: it sees that much blurred."""


class Uncertainty:
    """The expected corner error of a trajectory at any frame, in px, after the best alignment of the planes.

    Three things add up: what the photons leave open at the located instants; beyond the first and the last of them, the
    velocity, which is held; and what the last level still changed, since groups merged along a wrong motion confirm it.

    Attributes:
        change_px: how far the level moved the corners of the frames, on average, in px of a frame; None at the first.
    """

    change_px: float | None

    def __init__(self, located: LocatedLevel, after: Trajectory, before: Trajectory | None, n_frames: int) -> None:
        """Compare a level with the one before.

        Args:
            located: what the level measured.
            after: the motion known after the level.
            before: the motion known before it, None at the first level.
            n_frames: length of the capture.
        """
        self._instants = located.instants
        self._std_px = located.solution.std_px[located.solution.located]
        self._frames = np.unique(np.linspace(0, n_frames - 1, _COMPARED).round())
        shape, second = located.frame_shape, after.at(self._frames)
        if before is None:
            half = np.median([len(group.span) for group in located.groups]) / 2
            way = inverse(after.at(self._frames - half)) @ after.at(self._frames + half)
            self.change_px = None
            self._unsettled_px = _BLURRED * corner_displacements(way, np.eye(3), shape).mean(axis=-1)
        else:
            first = before.at(self._frames)
            moved = inverse(first) @ align_planes(second, first, shape) @ second
            changes_px = corner_displacements(moved, np.eye(3), shape).mean(axis=-1)
            self.change_px = float(changes_px.mean())
            self._unsettled_px = _UNSETTLED * changes_px

    @property
    def mean_px(self) -> float:
        """The expected corner error without what the level still changed, on average over the frames."""
        return float(self._measured(self._frames).mean())

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the expected corner error at N instants, in px: (N,). Infinite where a single exposure tells of no motion."""
        frames = np.asarray(frame_indices, dtype=np.float64)
        return np.asarray(np.hypot(self._measured(frames), np.interp(frames, self._frames, self._unsettled_px)))

    def _measured(self, frames: FloatArray) -> FloatArray:
        if len(self._instants) < 2:
            return np.full(frames.shape, np.inf)
        inside = np.interp(frames, self._instants, self._std_px)
        first, last = np.diff(self._instants)[[0, -1]]
        beyond = np.maximum((self._instants[0] - frames) / first, (frames - self._instants[-1]) / last)
        return np.asarray(inside * (1 + 2 * np.maximum(beyond, 0)))
