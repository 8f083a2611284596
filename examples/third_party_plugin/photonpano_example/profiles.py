"""Profiles of images, and the shift between two curves; needs numpy only."""

import numpy as np
from numpy.typing import NDArray


def profile(image: NDArray[np.float32], seen: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """Return the mean of each column (axis 0) or row (axis 1) over the pixels that were seen; NaN where none was."""
    count = seen.sum(axis=axis)
    total = np.where(seen, image, 0).sum(axis=axis, dtype=np.float64)
    mean = np.full(len(count), np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return mean


def offset(moving: NDArray[np.float64], fixed: NDArray[np.float64], furthest: int) -> float:
    """Return the shift in samples, at most `furthest`, that maximises the correlation of two curves.

    A parabola through the best correlation and its neighbours gives the fraction of a sample.
    """
    size = len(moving)
    furthest = min(furthest, size - 1)
    shifts = range(-furthest, furthest + 1)
    scores = [
        correlation(moving[max(0, -shift) : size - max(0, shift)], fixed[max(0, shift) : size + min(0, shift)])
        for shift in shifts
    ]
    best = int(np.argmax(scores))
    if not 0 < best < len(scores) - 1:
        return float(shifts[best])
    before, top, after = scores[best - 1 : best + 2]
    curvature = before - 2 * top + after
    return shifts[best] + ((before - after) / (2 * curvature) if curvature < 0 else 0.0)


def correlation(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the correlation of two curves where both are known; 0 if one of them is flat."""
    known = np.isfinite(first) & np.isfinite(second)
    if not known.any():
        return 0.0
    first, second = first[known] - first[known].mean(), second[known] - second[known].mean()
    size = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / size) if size > 0 else 0.0
