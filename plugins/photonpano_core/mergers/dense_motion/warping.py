"""Add warps of images to pixels of a grid that move beyond a homography. Compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photonpano import BoolArray, FloatArray
from photonpano.compiling import compiled
from photonpano_core.mergers.dense_motion.field import Image


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
