"""Add bilinear warps of images to a grid, vectorised along runs of pixels whose neighbours lie at neighbours of the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.geometry.sampling import Pixels, run_from, sample_run, visible_columns


@compiled
def add_warped(image: Pixels, to_image: NDArray[np.float64], total: NDArray[np.float32]) -> None:
    """Add an image to a grid, interpolated bilinearly; the image is 0 outside of its border.

    Args:
        image: (h, w) float32 or uint32.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        total: (H, W) the grid.
    """
    sampled = np.empty(total.shape[1], np.float32)
    for y in range(total.shape[0]):
        row = total[y]
        first, inside, outside, last = _parts(image.shape, to_image, y, total.shape[1])
        for x in range(first, inside):
            row[x] += _at(image, to_image, x, y)
        for x in range(outside, last):
            row[x] += _at(image, to_image, x, y)
        x = inside
        while x < outside:
            run = run_from(to_image, x, y, outside - x, image.shape[0], image.shape[1])
            sample_run(image, run, sampled[x : x + run.size])
            x += run.size
        totals, values = row[inside:outside], sampled[inside:outside]
        for t in range(len(totals)):
            totals[t] += values[t]


@compiled
def add_footprint(
    shape: tuple[int, int], to_image: NDArray[np.float64], value: float, steps: NDArray[np.float32], total: NDArray[np.float32]
) -> None:
    """Add what `add_warped` adds for an image of one value, but compute pixels at its border only.

    Args:
        shape: (h, w) of the image.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        value: value of every pixel.
        steps: (H, W + 1), row-wise differences; add their cumulative sums to `total` with `add_running_sums` in the end.
        total: (H, W) the grid.
    """
    for y in range(total.shape[0]):
        first, inside, outside, last = _parts(shape, to_image, y, total.shape[1])
        steps[y, inside] += value
        steps[y, outside] -= value
        for x in range(first, inside):
            total[y, x] += value * _coverage(shape, to_image, x, y)
        for x in range(outside, last):
            total[y, x] += value * _coverage(shape, to_image, x, y)


@compiled
def add_running_sums(steps: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add the cumulative sums of `steps` along each row; see `add_footprint`."""
    for y in range(total.shape[0]):
        running, row, step = 0.0, total[y], steps[y]
        for x in range(len(row)):
            running += step[x]
            row[x] += np.float32(running)


def average_squares(image: Pixels, side: int) -> NDArray[np.float32]:
    """Average squares of pixels, (h, w) to (ceil(h / side), ceil(w / side)); the image is padded with 0 to whole squares."""
    if side == 1:
        return np.asarray(image, dtype=np.float32)
    averages = np.zeros((-(-image.shape[0] // side), -(-image.shape[1] // side)), np.float32)
    _add_squares(image, side, averages)
    return averages


@compiled
def _add_squares(image: Pixels, side: int, averages: NDArray[np.float32]) -> None:
    share = np.float32(1 / side**2)
    for y in range(image.shape[0]):
        row, into = image[y], averages[y // side]
        whole = len(row) // side
        for t in range(whole):
            for x in range(side):
                into[t] += share * np.float32(row[t * side + x])
        for x in range(whole * side, len(row)):
            into[whole] += share * np.float32(row[x])


@compiled
def _parts(shape: tuple[int, int], to_image: NDArray[np.float64], y: int, columns: int) -> tuple[int, int, int, int]:
    """Divide a row of a grid.

    Returns:
        first, inside, outside, last: the image contributes to pixels from `first` to `last`, half-open, and those from
        `inside` to `outside` have four neighbours in the image.
    """
    height, width = shape
    first, last = visible_columns(to_image, y, -1.0, width, -1.0, height, columns)
    inside, outside = visible_columns(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, columns)
    if inside >= outside:
        return first, last, last, last
    return first, inside, outside, last


@compiled
def _at(image: Pixels, to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate at the border, beyond which the image is 0."""
    height, width = image.shape
    u, v = _mapped(to_image, x, y)
    left, top = int(np.floor(u)), int(np.floor(v))
    total = 0.0
    for j in range(max(top, 0), min(top + 2, height)):
        for i in range(max(left, 0), min(left + 2, width)):
            total += image[j, i] * (1 - abs(u - i)) * (1 - abs(v - j))
    return total


@compiled
def _coverage(shape: tuple[int, int], to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate an image of ones at its border."""
    height, width = shape
    u, v = _mapped(to_image, x, y)
    along = max(0.0, min(1.0, 1 + min(u, width - 1 - u)))
    across = max(0.0, min(1.0, 1 + min(v, height - 1 - v)))
    return along * across


@compiled
def _mapped(to_image: NDArray[np.float64], x: int, y: int) -> tuple[float, float]:
    depth = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2]
    return (
        (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) / depth,
        (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) / depth,
    )
