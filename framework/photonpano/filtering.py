"""Filters: of a series of steps, whose spectrum is estimated from the series itself; differences of paths and images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from photonpano.values import FloatArray

WINDOW = 128  # longest window of the spectra, in steps: a tremor may change from one window to the next
# Minimum power of a frequency that is kept, relative to the noise, averaged over 3 windows by 3 frequencies.
SIGNIFICANT = 3.0
# Systematic error of a step: frames and panorama are interpolated at different fractions of a pixel.
SYSTEMATIC_PX = 0.015
# Number of lowest frequencies with an additional error, and its size in px: the reference itself follows slow motion.
SLOW = 2, 0.04


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """A series after a Wiener filter."""

    signal: FloatArray  # (S,) what exceeds the noise
    std: FloatArray  # (S,) the noise that the filter let through, as an expected error


def gradient_of(image: NDArray[Any]) -> NDArray[Any]:
    """Return the central differences of an image along y and x, (2, h, w): 0 along an axis of a single pixel."""
    return np.stack([np.gradient(image, axis=axis) if n > 1 else np.zeros_like(image) for axis, n in enumerate(image.shape)])


def exceeding_noise(steps: FloatArray, variances: FloatArray) -> Filtered:
    """Denoise a series of steps, (S,) in px, with an empirical Wiener filter, window by window.

    The `variances` of their photon noise, (S,), are infinite where a step is unknown.
    """
    size = min(WINDOW, 2 ** int(np.log2(len(steps))))
    known = np.isfinite(variances)
    if known.sum() < size // 2:
        return Filtered(np.zeros(len(steps)), np.zeros(len(steps)))
    # A step of large noise, over a dark place, would drown its window: it counts for less.
    typical = float(np.median(variances[known]))
    trust = np.where(known, typical / (typical + np.maximum(variances - typical, 0)), 0.0)
    noise = (
        np.where(known, np.minimum(variances, typical / np.maximum(trust, 1e-9)), 0.0) * trust**2 + SYSTEMATIC_PX**2 * trust**2
    )
    half, (slow_bins, slow_px) = size // 2, SLOW
    n_windows = -(-len(steps) // half) + 1
    end = (n_windows + 1) * half - len(steps) - half
    series, variance = (np.pad(each, (half, end), mode="reflect") for each in (steps * trust, noise))
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size)
    windows = np.fft.rfft(sliding_window_view(series, size)[::half] * taper)
    expected = sliding_window_view(variance, size)[::half] @ taper**2
    floor = np.tile(expected[:, None], windows.shape[1])
    floor[:, :slow_bins] += (slow_px * taper.sum()) ** 2
    excess = np.abs(windows) ** 2 / np.maximum(floor, 1e-30)
    mean = sliding_window_view(np.pad(excess, 1, mode="edge"), (3, 3)).mean(axis=(2, 3))
    gain = np.where(mean > SIGNIFICANT, 1 - 1 / np.maximum(mean, 1), 0)
    restored = np.fft.irfft(windows * gain, size) * taper
    # Each frequency between the first and the last counts twice, for its negative.
    weights = np.r_[1, np.full(half - 1, 2), 1] / size
    let_through = (gain * weights).sum(axis=1) * expected / (size / 2)
    signal, spread = np.zeros(len(series)), np.zeros(len(series))
    for window in range(len(windows)):
        place = slice(window * half, window * half + size)
        signal[place] += restored[window]
        spread[place] += let_through[window] * taper**2
    inner = slice(half, half + len(steps))
    return Filtered(signal[inner], np.sqrt(spread[inner]))


def smooth_share(path: FloatArray) -> float:
    """Return how far accelerations predict an evenly sampled path: 1 if it is smooth, 0 if it trembles as fast as samples.

    It is the share of the squares of second differences that third differences do not have. Noise has none. The path has (N, K)
    values, at least 4.
    """
    second, third = (float((np.diff(path, order, axis=0) ** 2).mean()) for order in (2, 3))
    return float(np.clip(1 - third / max(second, np.finfo(float).tiny), 0, 1))
