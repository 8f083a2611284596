"""A dense field of motion beyond the global one, and sums of frames along it. Compiled.

The motion of each pixel is a polynomial of time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray
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
        _value_of_each(self.coefficients.reshape(len(self.coefficients), -1), np.float32(elapsed), displacement.reshape(-1))
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
def _value_of_each(coefficients: Image, time: np.float32, found: Image) -> None:
    """Evaluate polynomials with coefficients (D, N) of the powers 1 to D of time, by Horner's rule, into `found` (N,)."""
    found[:] = 0
    for degree in range(len(coefficients) - 1, -1, -1):
        own = coefficients[degree]
        for i in range(len(found)):
            found[i] = time * (found[i] + own[i])


class Frames(NamedTuple):
    """A sum of frames."""

    image: Image  # (h, w) sum
    weights: Image  # (h, w) of a frame of each pixel, from 0 to 1; (0, 0) if it is 1 for all
    number: float


class Moved(NamedTuple):
    """Motion of the pixels of a grid beyond a homography, in cells of a coarser or finer grid."""

    where: BoolArray  # (H, W) pixels of the grid that are added to
    # cells per pixel, and the row and the column of the first cell. Pixels in one cell move alike
    cells: tuple[float, int, int]
    motion: Image  # (h', w', 2), x and y by which cells are displaced, in cells
    trust: Image  # (h', w') weight of the image in each cell


class Sums(NamedTuple):
    """Sums that `add_along` adds to."""

    counts: Image  # (H, W) sums
    weight: Image  # (H, W) numbers of frames
    # (H, W) variances of the blur of interpolation, mean of x and y in px^2, times numbers of frames; (0, 0) for none
    blur: Image


@compiled
def add_along(summed: Frames, to_image: FloatArray, moved: Moved, sums: Sums) -> None:
    """Add a sum of frames to some pixels of a grid, which (3, 3) maps to the image, bilinearly; 0 outside of its border."""
    image, weights, where, trust = summed.image, summed.weights, moved.where, moved.trust
    counts, weight, blur = sums.counts, sums.weight, sums.blur
    scale, first_row, first_column = moved.cells
    height, width = image.shape
    frames, per_cell, last = np.float32(summed.number), 1 / scale, where.shape[1]
    steps = np.arange(last)
    columns = np.minimum(np.maximum(((steps + 0.5) * scale).astype(np.int64) - first_column, 0), trust.shape[1] - 1)
    us, vs, shares = np.empty(last), np.empty(last), np.empty(last, np.float32)
    for row in range(where.shape[0]):
        inside, first, stop = where[row], 0, last
        while first < stop and not inside[first]:
            first += 1
        while stop > first and not inside[stop - 1]:
            stop -= 1
        if first == stop:
            continue
        cell = min(max(int((row + 0.5) * scale) - first_row, 0), trust.shape[0] - 1)
        displaced, trusted = moved.motion[cell], trust[cell]
        for i in range(first, stop):
            at = columns[i]
            us[i], vs[i], shares[i] = i + per_cell * displaced[at, 0], row + per_cell * displaced[at, 1], trusted[at]
        _map(to_image, us[first:stop], vs[first:stop])
        into, of = counts[row], weight[row]
        for i in range(first, stop):
            u, v, share = us[i], vs[i], shares[i]
            if not (inside[i] and -1 < u < width and -1 < v < height):
                continue
            left, top = int(u + 1) - 1, int(v + 1) - 1
            a, b = np.float32(u - left), np.float32(v - top)
            if 0 <= left < width - 1 and 0 <= top < height - 1:
                into[i] += share * _between(image, top, left, a, b)
                seen = share * frames * (_between(weights, top, left, a, b) if weights.size else np.float32(1))
                of[i] += seen
                if blur.size:
                    blur[row, i] += seen * np.float32(0.5) * (a * (1 - a) + b * (1 - b))
                continue
            for down in range(2):
                for right in range(2):
                    y, x = top + down, left + right
                    if 0 <= y < height and 0 <= x < width:
                        part = share * (b if down else 1 - b) * (a if right else 1 - a)
                        into[i] += part * image[y, x]
                        of[i] += part * frames * (weights[y, x] if weights.size else np.float32(1))


@compiled
def _map(to_image: FloatArray, us: FloatArray, vs: FloatArray) -> None:
    """Replace places (x, y) on a grid by those in an image."""
    xx, xy, x1 = to_image[0, 0], to_image[0, 1], to_image[0, 2]
    yx, yy, y1 = to_image[1, 0], to_image[1, 1], to_image[1, 2]
    zx, zy, z1 = to_image[2, 0], to_image[2, 1], to_image[2, 2]
    for i in range(len(us)):
        x, y = us[i], vs[i]
        per_depth = 1 / (zx * x + zy * y + z1)
        us[i] = (xx * x + xy * y + x1) * per_depth
        vs[i] = (yx * x + yy * y + y1) * per_depth


@compiled
def _between(image: Image, top: int, left: int, a: np.float32, b: np.float32) -> np.float32:
    """Interpolate between four pixels, at fractions of a pixel to the right and down of the first."""
    upper = image[top, left] + a * (image[top, left + 1] - image[top, left])
    lower = image[top + 1, left] + a * (image[top + 1, left + 1] - image[top + 1, left])
    return np.float32(upper + b * (lower - upper))


@compiled
def mean_of_seen(counts: Image, weight: Image, least: float, steepest: float, area: float, mean: Image, frames: Image) -> None:
    """Divide counts by weights, (H, W), where these exceed `least`, and their gradient is below `steepest` relative to them.

    Writes the mean count of a frame, and the frames of one pixel whose noise equals that of an average over `area` pixels, 1 or
    more; both 0 where unseen.
    """
    height, width = counts.shape
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            left, right, here = max(column - 1, 0), min(column + 1, width - 1), weight[row, column]
            down = (weight[below, column] - weight[above, column]) / max(below - above, 1)
            along = (weight[row, right] - weight[row, left]) / max(right - left, 1)
            if here > least and down * down + along * along < (steepest * here) ** 2:
                mean[row, column] = max(counts[row, column], np.float32(0)) / here
                frames[row, column] = max(here * np.float32(area), np.float32(1))
            else:
                mean[row, column], frames[row, column] = 0, 0
