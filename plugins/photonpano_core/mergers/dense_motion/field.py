"""A dense field of motion beyond the global one: a polynomial of time at each pixel, fitted and evaluated by compiled code."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray
from photonpano.compiling import compiled

Image = NDArray[np.float32]

_STEPS = 8  # line segments that approximate the path of a pixel


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
        """Length of the path of each pixel per unit of time, from -1 to 1: (H, W), in px of the grid."""
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


@compiled
def add_moments(time: np.float32, value: Image, trust: Image, moments: Image, right: Image) -> None:
    """Add the values (H, W, 2) of pixels at a time, with weights (H, W), to the sums from which `fit_each` fits polynomials."""
    for row in range(trust.shape[0]):
        weights, xy = trust[row], value[row]
        power = time
        for d in range(len(moments)):
            power *= time
            to = moments[d, row]
            for i in range(len(to)):
                to[i] += power * weights[i]
        power = np.float32(1)
        for d in range(len(right)):
            power *= time
            into = right[d, row]
            for i in range(len(into)):
                into[i, 0] += power * weights[i] * xy[i, 0]
                into[i, 1] += power * weights[i] * xy[i, 1]


@compiled
def fit_each(moments: Image, right: Image, prior: float, where: BoolArray, found: Image) -> None:
    """Solve a least-squares fit of polynomials without a constant term at some pixels, (H, W), by Cholesky decomposition.

    `moments` (2 D - 1, H, W) are weighted sums of the powers 2 to 2 D of time, `right` (D, H, W, 2) those of the powers 1 to D
    times x and y. `prior` is added to the diagonal. Writes the coefficients of the powers 1 to D, (D, H, W, 2).
    """
    degree = right.shape[0]
    lower, x = np.zeros((degree, degree)), np.zeros((degree, 2))
    for row in range(where.shape[0]):
        for column in range(where.shape[1]):
            if not where[row, column]:
                continue
            for i in range(degree):
                for j in range(i + 1):
                    total = float(moments[i + j, row, column]) + (prior if i == j else 0.0)
                    for k in range(j):
                        total -= lower[i, k] * lower[j, k]
                    # float32 moments may be singular by rounding errors.
                    lower[i, j] = np.sqrt(max(total, 0.1 * prior)) if i == j else total / lower[j, j]
            for axis in range(2):
                for i in range(degree):
                    total = float(right[i, row, column, axis])
                    for k in range(i):
                        total -= lower[i, k] * x[k, axis]
                    x[i, axis] = total / lower[i, i]
                for i in range(degree - 1, -1, -1):
                    total = x[i, axis]
                    for k in range(i + 1, degree):
                        total -= lower[k, i] * x[k, axis]
                    x[i, axis] = total / lower[i, i]
                for i in range(degree):
                    found[i, row, column, axis] = x[i, axis]


@compiled
def value_of_each(coefficients: Image, time: np.float32, found: Image) -> None:
    """Evaluate polynomials with coefficients (D, N) of the powers 1 to D of time, by Horner's rule, into `found` (N,)."""
    found[:] = 0
    for degree in range(len(coefficients) - 1, -1, -1):
        own = coefficients[degree]
        for i in range(len(found)):
            found[i] = time * (found[i] + own[i])
