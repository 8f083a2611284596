"""Warps that add up as they go: bilinear, exact, and vectorised along runs of pixels that look at neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.compiling import compiled
from photonpano.geometry.sampling import run_from, seen_part

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Pixels: TypeAlias = NDArray[np.float32] | NDArray[np.uint32]


@compiled
def add_warped(
    image: NDArray[np.float32] | NDArray[np.uint32], to_image: NDArray[np.float64], total: NDArray[np.float32]
) -> None:
    """Add an image to a grid: at each pixel, what lies there, interpolated linearly; nothing outside of the image.

    Args:
        image: (h, w) float32 or uint32.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        total: (H, W) the grid.
    """
    height, width = image.shape
    for y in range(total.shape[0]):
        row = total[y]
        first, last = seen_part(to_image, y, -1.0, width, -1.0, height, total.shape[1])
        if first >= last:
            continue
        inside, outside = seen_part(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, total.shape[1])
        if inside >= outside:
            inside = outside = last
        for x in range(first, inside):
            row[x] += _at(image, to_image, x, y)
        for x in range(max(first, outside), last):
            row[x] += _at(image, to_image, x, y)
        x = inside
        while x < outside:
            x += _add_run(image, to_image, x, y, row[x:outside])


@compiled
def add_footprint(
    shape: tuple[int, int], to_image: NDArray[np.float64], value: float, steps: NDArray[np.float32], total: NDArray[np.float32]
) -> None:
    """Add what `add_warped` would add for an image of one value, at the cost of its border alone.

    Args:
        shape: (h, w) of the image.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        value: that of every pixel.
        steps: (H, W + 1) whose sums along rows are to be added to `total` in the end.
        total: (H, W) the grid.
    """
    height, width = shape
    for y in range(total.shape[0]):
        first, last = seen_part(to_image, y, -1.0, width, -1.0, height, total.shape[1])
        if first >= last:
            continue
        inside, outside = seen_part(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, total.shape[1])
        if inside >= outside:
            inside = outside = last
        else:
            steps[y, inside] += value
            steps[y, outside] -= value
        for x in range(first, inside):
            total[y, x] += value * _coverage(height, width, to_image, x, y)
        for x in range(max(first, outside), last):
            total[y, x] += value * _coverage(height, width, to_image, x, y)


@compiled
def _add_run(image: Pixels, to_image: NDArray[np.float64], x: int, y: int, row: NDArray[np.float32]) -> int:
    """Add to the run of pixels from x on; return how many they are."""
    height, width = image.shape
    run = run_from(to_image, x, y, len(row), height, width)
    pixels = image.reshape(-1)
    # An index without a sign needs no look at whether it counts from the end.
    above, one = np.uint64(run.top * width + run.left), np.uint64(1)
    below = above + np.uint64(width)
    a0, a1, a2, b0, b1, slope = run.a0, run.a1, run.a2, run.b0, run.b1, run.slope
    for t in range(run.size):
        t_px = np.float32(t)
        scale = np.float32(1) / (np.float32(1) + slope * t_px)
        a, b = (a0 + t_px * (a1 + t_px * a2)) * scale, (b0 + t_px * b1) * scale
        i, j = above + np.uint64(t), below + np.uint64(t)
        p, q = np.float32(pixels[i]), np.float32(pixels[j])
        upper, lower = p + a * (np.float32(pixels[i + one]) - p), q + a * (np.float32(pixels[j + one]) - q)
        row[t] += upper + b * (lower - upper)
    return run.size


@compiled
def _at(image: Pixels, to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate at the border, beyond which there is nothing."""
    height, width = image.shape
    u, v = _mapped(to_image, x, y)
    left, top = int(np.floor(u)), int(np.floor(v))
    total = 0.0
    for j in range(max(top, 0), min(top + 2, height)):
        for i in range(max(left, 0), min(left + 2, width)):
            total += image[j, i] * (1 - abs(u - i)) * (1 - abs(v - j))
    return total


@compiled
def _coverage(height: int, width: int, to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate an image of ones at its border."""
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
