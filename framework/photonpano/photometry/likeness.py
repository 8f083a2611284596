"""How alike two noisy images are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.values import FloatArray

_FEWEST = 50
"""Fewer independent pixels than this correlate by chance."""
_STANDS_OUT = 5.0
"""The variance of a scene exceeds that of the noise by at least so many of its standard errors."""


def noise_free_correlation(
    first: NDArray[np.float32], second: NDArray[np.float32], noise: tuple[float, float], independent: float
) -> float:
    """Return the correlation that two images would have without their noise.

    Args:
        first: (N,) pixels of one image.
        second: (N,) what the other one shows there.
        noise: the variance of the noise of a pixel of each.
        independent: how many of the N pixels have noise of their own; fewer where images were blurred.

    Returns:
        1 where they show the same; around 0 where they do not, and 0 where there are hardly any pixels, or nothing stands out
        from the noise, so that any two places look alike.
    """
    return correlation_without_noise(np.cov(first, second), noise, independent)


def correlation_without_noise(covariance: FloatArray, noise: tuple[float, float], independent: float) -> float:
    """Return the correlation that two images would have without their noise; see `noise_free_correlation`.

    Args:
        covariance: (2, 2) that of the pixels of both images.
        noise: the variance of the noise of a pixel of each.
        independent: how many pixels have noise of their own.
    """
    if independent < _FEWEST:
        return 0.0
    (first, both), (_, second) = np.asarray(covariance).tolist()
    scene = first - noise[0], second - noise[1]
    if any(left < _STANDS_OUT * math.sqrt(2 / independent) * of for left, of in zip(scene, noise, strict=True)):
        return 0.0
    return float(both / math.sqrt(scene[0] * scene[1]))
