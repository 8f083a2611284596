"""A dense field of motion beyond the global one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray
from photonpano_core.dense_motion.polynomials import value_of_each

Image = NDArray[np.float32]

_STEPS = 8  # straight lines by which a path is measured


@dataclass(frozen=True, slots=True, eq=False)
class MotionField:
    """Motion of each pixel of a grid beyond the global motion, as a polynomial of time that is 0 at the reference instant.

    Convention:
        What lies at the pixel p at the reference instant lies at `p + at(elapsed)` later, both along the global motion. Points
        are (x, y), integers are pixel centres. Time is relative to the longer part of the group before or after.
    """

    coefficients: Image  # (D, H, W, 2), in px of the grid: the displacement is `sum_d coefficients[d] elapsed^(d + 1)`

    @classmethod
    def zero(cls, shape: tuple[int, int]) -> MotionField:
        """Return a field without motion."""
        return cls(np.zeros((1, *shape, 2), np.float32))

    def at(self, elapsed: float) -> Image:
        """Return the displacement at a time: (H, W, 2), x and y in px of the grid."""
        displacement = np.empty(self.coefficients.shape[1:], np.float32)
        value_of_each(self.coefficients.reshape(len(self.coefficients), -1), np.float32(elapsed), displacement.reshape(-1))
        return displacement

    @property
    def way_px(self) -> Image:
        """How far each pixel moves in a unit of time, on average over two: (H, W), in px of the grid."""
        places = [self.at(elapsed) for elapsed in np.linspace(-1, 1, _STEPS + 1)]
        ways = (after - before for before, after in pairwise(places))
        return np.asarray(sum(np.sqrt(way[..., 0] ** 2 + way[..., 1] ** 2) for way in ways) / 2, np.float32)

    def filled(self, known: BoolArray) -> MotionField:
        """Return the field in which each pixel moves as the nearest one that is known, (H, W)."""
        _, labels = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int64)
        places[labels[known]] = np.flatnonzero(known)
        return MotionField(np.stack([each.reshape(-1, 2)[places[labels]] for each in self.coefficients]))
