"""The gauge: a trajectory seen from its reference frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano.geometry import inverse, normalised

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from photonpano.protocols import Trajectory
    from photonpano.values import FloatArray


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
