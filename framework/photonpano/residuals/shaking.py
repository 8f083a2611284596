"""Motion that is faster than a span of frames: the scatter of single frames within it, beyond that of photon noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.values import FloatArray

_SIGNIFICANT = 4.0  # standard deviations by which the scatter must exceed that of noise
_SMALLEST_PX = 0.02  # shaking by less than this stays within spans
_FREQUENCIES = 256  # at which the spectrum is computed, up to half a cycle per frame


@dataclass(frozen=True, slots=True)
class Shaking:
    """What single frames of some windows show of motion that the spans average over."""

    size_px: float  # root mean square within a span, beyond a shift and a velocity of the span; 0 if noise explains it
    period_frames: float  # of the strongest frequency; NaN if nothing was found
    span_frames: int  # longest span within which no shaking is significant


def find_shaking(shifts: FloatArray, variances: FloatArray, size: int) -> Shaking:
    """Compare the scatter of single frames within spans of `size` frames with photon noise.

    Args:
        shifts: (W, F, 2) shifts in px of the F frames of each of W windows against the panorama.
        variances: (W, F, 2) their variances by photon noise.
        size: frames of a span, F at most.
    """
    found, span = scatter_px(shifts, variances, size), size
    if not found:
        return Shaking(0.0, float("nan"), size)
    # A shift and a velocity describe any two frames: spans that are so short measure single ones.
    while span > 2 and scatter_px(shifts, variances, span):
        span //= 2
    return Shaking(found, _period(shifts, variances), span if span > 2 else 1)


def scatter_px(shifts: FloatArray, variances: FloatArray, size: int) -> float:
    """Return the root mean square of shifts beyond a line through each `size` frames, and beyond noise; 0 if noise explains it.

    The mean square of n frames of a known variance has the standard deviation sqrt(2 / n) of that variance.
    """
    n_windows, n_frames, _ = shifts.shape
    pieces = n_frames // size
    free = size - 2
    if free < 1 or not pieces:
        return 0.0
    kept = shifts[:, : pieces * size].reshape(n_windows * pieces, size, 2)
    noise = variances[:, : pieces * size].reshape(n_windows * pieces, size, 2)
    known = np.isfinite(noise).all(axis=(1, 2))
    if not known.any():
        return 0.0
    line = np.stack([np.ones(size), np.arange(size)], axis=1)
    left = kept[known] - line @ (np.linalg.pinv(line) @ kept[known])
    squares, expected = (left**2).sum(axis=1) / free, noise[known].mean(axis=1)
    # Where one direction has little texture, its noise hides nothing that the other one shows.
    excess = (squares - expected).mean(axis=0)
    std = np.sqrt(2 / free * (expected**2).sum(axis=0)) / len(expected)
    significant = excess > _SIGNIFICANT * std
    size_px = float(np.sqrt(excess[significant].sum()))
    return size_px if size_px > _SMALLEST_PX else 0.0


def _period(shifts: FloatArray, variances: FloatArray) -> float:
    """Return the period in frames at which the power of the windows is largest."""
    n_frames = shifts.shape[1]
    frames = np.arange(n_frames)
    line = np.stack([np.ones(n_frames), frames], axis=1)
    left = np.nan_to_num(shifts - line @ (np.linalg.pinv(line) @ shifts))
    cycles = np.linspace(1 / n_frames, 0.5, _FREQUENCIES)
    waves = np.exp(-2j * np.pi * cycles[:, None] * frames) * np.hanning(n_frames + 2)[1:-1]
    power = (np.abs(waves @ left) ** 2).mean(axis=0)
    return float(1 / cycles[int((power / np.nanmedian(variances, axis=(0, 1))).sum(axis=1).argmax())])
