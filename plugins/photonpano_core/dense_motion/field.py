"""A dense field of motion beyond the global one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

_STEPS = 8
"""Straight lines by which a path is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionField:
    """Motion of each pixel of an exposure beyond the global motion, as a polynomial of time that is 0 at the reference instant.

    Convention:
        What lies at the pixel p at the reference instant lies at `p + at(elapsed)` a time later, if both are seen along the
        global motion. Points are (x, y), integers are pixel centres. Time is a share of the longer part of the group before or
        after the reference instant.

    Attributes:
        coefficients: (D, 2, H, W) float32, in px of the exposure: the displacement is `sum_d coefficients[d] elapsed^(d + 1)`.
    """

    coefficients: Image

    @classmethod
    def zero(cls, shape: tuple[int, int]) -> MotionField:
        """Return a field without motion."""
        return cls(np.zeros((1, 2, *shape), np.float32))

    def at(self, elapsed: float) -> Image:
        """Return the displacement at a time: (2, H, W), x and y in px of the exposure."""
        powers = np.float32(elapsed) ** np.arange(1, len(self.coefficients) + 1, dtype=np.float32)
        return np.asarray(np.tensordot(powers, self.coefficients, axes=1), np.float32)

    @property
    def way_px(self) -> Image:
        """How far each pixel moves in a unit of time, on average over two: (H, W), in px of the exposure."""
        places = [self.at(elapsed) for elapsed in np.linspace(-1, 1, _STEPS + 1)]
        return np.asarray(sum(np.hypot(*(after - before)) for before, after in pairwise(places)) / 2, np.float32)

    def filled(self, known: NDArray[np.bool_]) -> MotionField:
        """Return the field in which each pixel moves as the nearest one that is known, (H, W)."""
        _, labels = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int64)
        places[labels[known]] = np.flatnonzero(known)
        return MotionField(self.coefficients.reshape(-1, known.size)[:, places[labels]].reshape(self.coefficients.shape))
