"""The gauge: a trajectory seen from its reference frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry import inverse, normalised

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from photonpano.protocols import Trajectory
    from photonpano.values import BoolArray, FloatArray, FrameSpan


class ReferencedTrajectory:
    """A trajectory whose homography at the reference frame is the identity.

    Convention:
        `at` maps a frame's pixels to the pixels of the reference frame; h33 = 1.
    """

    def __init__(self, free: Trajectory, reference: int, covered: FrameSpan) -> None:
        """Fix the gauge of a trajectory.

        Args:
            free: the trajectory in any plane.
            reference: the frame whose homography is the identity.
            covered: the frames from the first to the last that located exposures hold.
        """
        self._free = free
        self._covered = covered
        self._to_reference = inverse(free.at([reference])[0])

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        return normalised(self._to_reference @ self._free.at(frame_indices))

    def located(self, frame_indices: ArrayLike) -> BoolArray:
        """Tell which of N instants lie within what was located: (N,).

        An exposure tells of all its frames. So the motion at the ends, beyond the last instant that was located, is known
        from photons, too.
        """
        frames = np.asarray(frame_indices, dtype=np.float64)
        return np.asarray((self._covered.start <= frames) & (frames <= self._covered.stop - 1))
