"""A motion that is given frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry.homographies import BLOCK_FRAMES
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
        instants = np.asarray(frame_indices, dtype=np.float64)
        found, last = np.empty((len(instants), 3, 3)), len(self._homographies) - 1
        for start in range(0, len(instants), BLOCK_FRAMES):
            block = np.clip(instants[start : start + BLOCK_FRAMES], 0, last)
            before = np.floor(block).astype(int)
            share = (block - before)[:, None, None]
            after = np.minimum(before + 1, last)
            found[start : start + len(block)] = (1 - share) * self._homographies[before] + share * self._homographies[after]
        return found
