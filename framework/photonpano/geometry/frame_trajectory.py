"""A motion that is given frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.values import FloatArray


class FrameTrajectory:
    """A trajectory given at every frame: linear between frames, constant beyond the first and last.

    Args:
        homographies: (T, 3, 3) float64, frame pixels to reference pixels, h33 = 1.
    """

    def __init__(self, homographies: FloatArray) -> None:
        self._homographies = np.asarray(homographies, dtype=np.float64)

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, in frames: (N, 3, 3)."""
        last = len(self._homographies) - 1
        instants = np.clip(np.asarray(frame_indices, dtype=np.float64), 0, last)
        before = np.floor(instants).astype(int)
        share = (instants - before)[..., None, None]
        after = np.minimum(before + 1, last)
        return np.asarray((1 - share) * self._homographies[before] + share * self._homographies[after])
