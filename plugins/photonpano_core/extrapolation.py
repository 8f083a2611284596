"""What trajectories do beyond their knots."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray


class HeldTrajectory(ABC):
    """A trajectory that holds its velocity beyond the first and last knot for a bounded distance, and then stands still.

    A polynomial would run away.
    """

    def __init__(self, instants: NDArray[np.float64], hold_frames: float | None) -> None:
        """Take the (N,) increasing instants of the knots; by default the velocity is held for twice their mean distance."""
        self._first, self._last = float(instants[0]), float(instants[-1])
        spacing = (self._last - self._first) / max(1, len(instants) - 1)
        self._hold = 2 * spacing if hold_frames is None else hold_frames

    def at(self, frame_indices: ArrayLike) -> NDArray[np.float64]:
        """Return the homographies of N instants: (N, 3, 3)."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        inside = np.clip(frames, self._first, self._last)
        return self._moved_on(inside, np.clip(frames - inside, -self._hold, self._hold))

    @abstractmethod
    def _moved_on(self, inside: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the camera comes to from N instants between the knots, at the velocity that it has there.

        Args:
            inside: (N,) instants, none of them outside the knots.
            beyond: (N,) frames to go on, 0 for all but the first and last knot.

        Returns:
            (N, 3, 3) homographies with h33 = 1.
        """
