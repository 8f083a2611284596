"""Robust statistics of residuals: their scale, and weights for iteratively reweighted least squares."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from photonpano.values import FloatArray

# As `scipy.stats.median_abs_deviation(scale="normal")`, whose import takes a second, for residuals about 0.
_STD_PER_MEDIAN = 1 / NormalDist().inv_cdf(0.75)


def robust_std(residuals: NDArray[np.floating]) -> float:
    """Return the standard deviation of Gaussian residuals about 0 from the median of their magnitudes; 0 for none."""
    return _STD_PER_MEDIAN * float(np.median(np.abs(residuals))) if residuals.size else 0.0


def huber_weights(residuals: FloatArray, tuning: float) -> FloatArray:
    """Return the weights of Huber's loss, whose influence is constant beyond `tuning`: 1 within, tuning / |r| beyond."""
    return np.asarray(1 / np.maximum(1, np.abs(residuals) / tuning))


def cauchy_weights(residuals: FloatArray, tuning: float) -> FloatArray:
    """Return the weights of Cauchy's loss, 1 / (1 + (r / tuning)^2): a residual of `tuning` weighs half."""
    return np.asarray(1 / (1 + (residuals / tuning) ** 2))


def soft_l1_weights(lengths: FloatArray, tuning: float) -> FloatArray:
    """Return the weights of the soft L1 loss, 1 / sqrt(1 + (r / tuning)^2)."""
    return np.asarray(1 / np.sqrt(1 + (lengths / tuning) ** 2))
