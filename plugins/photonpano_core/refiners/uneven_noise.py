"""Separate a stationary motion from noise that is uneven in time, as where the light goes out between two flickers."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import uniform_filter

from photonpano import BoolArray, FloatArray
from photonpano.filtering import Filtered

_ROUNDS = 6  # steps of expectation maximisation; more change the motion by less than its noise
_UNKNOWN = 1e6  # variance of an unknown value, relative to the median of the others
_NEIGHBOURS = 3, 5  # windows and frequencies over which the power is averaged to test it


def separated(values: FloatArray, variances: FloatArray, size: int, significant: float, slow: tuple[int, float]) -> Filtered:
    """Estimate a motion (S,) whose spectrum is not known, in windows of `size` that overlap by half.

    In each window the motion is a Gaussian process. Its power at the frequencies that stand out from the noise by the factor
    `significant` is estimated by expectation and maximisation (Dempster et al. 1977), and the motion as its expectation (Wiener
    1949), also where nothing was measured and the variance is infinite. `slow` is the number of the lowest frequencies that
    must also exceed a constant of a size, and this size.
    """
    n = len(values)
    known = np.isfinite(variances)
    noise = np.where(known, variances, _UNKNOWN * float(np.median(variances[known])))
    measured = np.where(known, values, 0.0)
    starts = sorted({*range(0, n - size + 1, max(1, size // 2)), n - size})
    windows = [slice(start, start + size) for start in starts]
    standing = _standing_out([(measured[each], noise[each]) for each in windows], significant, slow)
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    signal, variance, total = np.zeros(n), np.zeros(n), np.zeros(n)
    for window, allowed in zip(windows, standing, strict=True):
        mean, spread = _expected(measured[window], noise[window], allowed)
        signal[window] += taper * mean
        variance[window] += taper * spread
        total[window] += taper
    return Filtered(signal / total, np.sqrt(np.maximum(variance / total, 0)))


def _standing_out(windows: list[tuple[FloatArray, FloatArray]], significant: float, slow: tuple[int, float]) -> BoolArray:
    """Return the frequencies of each window whose power exceeds that of the noise: (W, size + 1)."""
    lowest, floor = slow
    excess = []
    for values, noise in windows:
        precision = float((1 / noise).sum())
        power = np.abs(np.fft.rfft(values / noise, 2 * len(values))) ** 2 / precision
        power[: 2 * lowest] /= 1 + floor**2 * precision
        excess.append(power)
    return np.asarray(uniform_filter(np.array(excess), _NEIGHBOURS, mode="nearest") > significant)


def _expected(values: FloatArray, noise: FloatArray, allowed: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the expected motion in a window, half of a period of the process, and its variance: (size,) each."""
    size, period = len(values), 2 * len(values)
    if not allowed.any():
        return np.zeros(size), np.zeros(size)
    lag = np.arange(size)[:, None] - np.arange(size)
    weight = 1 / noise
    power = np.full(len(allowed), max(float((weight * (values**2 - noise)).sum() / weight.sum()), 1e-12))
    power[~allowed] = 0
    for round_ in range(_ROUNDS + 1):
        covariance = np.fft.irfft(power, period)[np.abs(lag)]
        inverted = np.linalg.inv(covariance + np.diag(noise))
        if round_ == _ROUNDS:
            break
        amplitude = np.abs(np.fft.rfft(inverted @ values, period)) ** 2
        # The sums along the diagonals of the inverse have the spectrum of the information about each frequency.
        sums = np.bincount((lag % period).ravel(), inverted.ravel(), period)
        power = np.maximum(power + power**2 * (amplitude - np.fft.rfft(sums).real) / period, 0)
    mean = covariance @ (inverted @ values)
    return mean, covariance[0, 0] - np.einsum("ij,jk,ki->i", covariance, inverted, covariance, optimize=True)
