"""Warps that add up as they go: bilinear, exact, and vectorised along runs of pixels that look at neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.compiling import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LONGEST_RUN = 256
"""So that small numbers stay exact enough in float32."""


def run_px(to_image: NDArray[np.float64], rows: slice, columns: slice) -> float:
    """Return for how many pixels of a row of a part of a grid, at its worst corner, each looks one pixel further right."""
    shortest = float(_LONGEST_RUN)
    for x in (columns.start, columns.stop):
        for y in (rows.start, rows.stop):
            u, v, depth = to_image @ (x, y, 1)
            drift = to_image[:2, 0] / depth - np.array([u, v]) * to_image[2, 0] / depth**2 - (1, 0)
            shortest = min(shortest, 1 / max(*np.abs(drift), 1e-9))
    return shortest


@compiled
def add_warped(image: NDArray[np.float32], to_image: NDArray[np.float64], total: NDArray[np.float32]) -> None:
    """Add an image to a grid: at each pixel, what lies there, interpolated linearly; nothing outside of the image.

    Args:
        image: (h, w).
        to_image: (3, 3), pixels of the grid to pixels of the image.
        total: (H, W) the grid.
    """
    height, width = image.shape
    for y in range(total.shape[0]):
        row = total[y]
        first, last = _seen(to_image, y, -1.0, width, -1.0, height, total.shape[1])
        if first >= last:
            continue
        inside, outside = _seen(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, total.shape[1])
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
        first, last = _seen(to_image, y, -1.0, width, -1.0, height, total.shape[1])
        if first >= last:
            continue
        inside, outside = _seen(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, total.shape[1])
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
def _seen(
    to_image: NDArray[np.float64], y: int, left: float, right: float, top: float, bottom: float, width: int
) -> tuple[int, int]:
    """Return the pixels of a row, half-open, that see a rectangle of the image, border included."""
    depth, along = to_image[2, 1] * y + to_image[2, 2], to_image[2, 0]
    u, du = to_image[0, 1] * y + to_image[0, 2], to_image[0, 0]
    v, dv = to_image[1, 1] * y + to_image[1, 2], to_image[1, 0]
    low, high = 0.0, width - 1.0
    # left <= (u + du x) / (depth + along x) and so on are linear where the depth is positive, as it is in front of the camera.
    for at, slope in (
        (u - left * depth, du - left * along),
        (right * depth - u, right * along - du),
        (v - top * depth, dv - top * along),
        (bottom * depth - v, bottom * along - dv),
        (depth, along),
    ):
        if slope > 0:
            low = max(low, -at / slope)
        elif slope < 0:
            high = min(high, -at / slope)
        elif at < 0:
            return 0, 0
    if not low <= high:
        return 0, 0
    return int(np.ceil(low)), int(np.floor(high)) + 1


@compiled
def _add_run(image: NDArray[np.float32], to_image: NDArray[np.float64], x: int, y: int, row: NDArray[np.float32]) -> int:
    """Add to pixels from x on as long as each looks one pixel further right than the last; return how many they are."""
    depth = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2]
    u = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) / depth
    v = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) / depth
    along = to_image[2, 0] / depth
    du, dv = to_image[0, 0] / depth - u * along, to_image[1, 0] / depth - v * along
    height, width = image.shape
    left, top = min(int(u), width - 2), min(int(v), height - 2)
    # The place t pixels further right looks at (right, down) + (t, 0), where (right, down) times its relative depth 1 + along t
    # are polynomials of t with small numbers.
    right, down = u - left, v - top
    right1, right2, down1 = du - 1 + right * along, -along, dv + down * along
    ahead = min(float(min(len(row), _LONGEST_RUN)), _positive_until(right, right1, right2))
    ahead = min(ahead, _positive_until(1 - right, along - right1, -right2))
    ahead = min(ahead, _positive_until(down, down1, 0.0))
    ahead = min(ahead, _positive_until(1 - down, along - down1, 0.0))
    size = max(1, min(int(ahead), width - 1 - left))
    pixels = image.reshape(-1)
    # An index without a sign needs no look at whether it counts from the end.
    above = np.uint64(top * width + left)
    below, one = above + np.uint64(width), np.uint64(1)
    a0, a1, a2 = np.float32(right), np.float32(right1), np.float32(right2)
    b0, b1, slope = np.float32(down), np.float32(down1), np.float32(along)
    for t in range(size):
        t_px = np.float32(t)
        scale = np.float32(1) / (np.float32(1) + slope * t_px)
        a, b = (a0 + t_px * (a1 + t_px * a2)) * scale, (b0 + t_px * b1) * scale
        i, j = above + np.uint64(t), below + np.uint64(t)
        upper = pixels[i] + a * (pixels[i + one] - pixels[i])
        lower = pixels[j] + a * (pixels[j + one] - pixels[j])
        row[t] += upper + b * (lower - upper)
    return int(size)


@compiled
def _positive_until(constant: float, linear: float, square: float) -> float:
    """Return where a polynomial that is positive at 0 first becomes negative."""
    if linear >= 0 and square >= 0:
        return float(_LONGEST_RUN)
    # Written so that it holds for a square of 0, too.
    discriminant = linear * linear - 4 * square * constant
    if discriminant < 0:
        return float(_LONGEST_RUN)
    below = -linear + np.sqrt(discriminant)
    return float(2 * constant / below) if below > 0 else float(_LONGEST_RUN)


@compiled
def _at(image: NDArray[np.float32], to_image: NDArray[np.float64], x: int, y: int) -> float:
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
