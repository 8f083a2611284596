"""Interpolate the gains of spans to each frame: with a smooth curve, and harmonics of a flicker."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from scipy.interpolate import UnivariateSpline

from photonpano.values import FloatArray

_HARMONICS = 3  # harmonics of a flicker that are fitted
_FEWEST_PERIODS, _FEWEST_SPANS = 2.5, 32  # of the capture, for a flicker to be searched for
_FINER = 16  # oversampling of frequency: steps per 1/T, for a capture of the duration T
_LINE_SHARE = 0.6  # least share of the changes of the light, without a slow curve, that a flicker explains
_SMALLEST = 0.01  # least root mean square of a flicker, relative to the light
_DARKEST = 0.02  # least gain of spans from which slow changes are fitted


def flicker_frequency(instants: FloatArray, gain: FloatArray) -> float:
    """Return the frequency of the strongest line in the spectrum of a series, in cycles per frame; 0 if none stands out.

    The instants (S,) are evenly spaced, in frames; `gain` is (S,), or (S, N) for several series of one frequency.
    """
    n = len(instants)
    if n < _FEWEST_SPANS:
        return 0.0
    spacing = (instants[-1] - instants[0]) / (n - 1)
    series = np.asarray(gain, float).reshape(n, -1)
    slow = np.linspace(-1, 1, n)[:, None] ** np.arange(4)
    rest = series - slow @ np.linalg.lstsq(slow, series)[0]
    power = (np.abs(np.fft.rfft(rest * np.hanning(n)[:, None], _FINER * n, axis=0)) ** 2).sum(axis=1)
    first = int(_FEWEST_PERIODS * _FINER)
    peak = first + int(power[first:].argmax())
    frequencies = (peak + np.linspace(-1, 1, 41)) / (_FINER * n * spacing)
    left = [_residual(instants, rest, slow, each) for each in frequencies]
    frequency = float(frequencies[int(np.argmin(left))])
    total = float((rest**2).sum())
    explained = total - min(left)
    if explained < _LINE_SHARE * total or explained / rest.size < _SMALLEST**2:
        return 0.0
    return frequency


def gain_of_frames(
    instants: FloatArray, gain: FloatArray, std: FloatArray, lengths: FloatArray, n_frames: int
) -> tuple[FloatArray, FloatArray, float]:
    """Return the gain of each frame, (T,), its standard deviation, (T,), and the frequency of its flicker, 0 if there is none.

    Args:
        instants: (S,) centres of spans, in frames.
        gain: (S,) mean gain of each.
        std: (S,) standard deviation of its logarithm.
        lengths: (S,) frames of each span, over which a flicker is averaged.
        n_frames: T.
    """
    frames = np.arange(n_frames, dtype=float)
    at = np.clip(frames, instants[0], instants[-1])
    frequency = flicker_frequency(instants, gain)
    if not frequency:
        logarithm = _smooth(instants, np.log(np.maximum(gain, 1e-3)), std)(at)
        return np.exp(logarithm), np.interp(frames, instants, std), 0.0
    # A slow change multiplies the flicker: both are fitted in turn.
    slow = np.ones(len(instants))
    for _ in range(3):
        waves = _waves(instants, frequency, lengths) * slow[:, None]
        coefficients = np.linalg.lstsq(waves, gain)[0]
        model = _waves(instants, frequency, lengths) @ coefficients
        known = model > _DARKEST
        ratio = np.log(np.maximum(gain[known], 1e-3) / model[known])
        curve = _smooth(instants[known], ratio, std[known] / np.minimum(1, model[known]))
        slow = np.exp(curve(np.clip(instants, instants[known][0], instants[known][-1])))
    found = _waves(frames, frequency, np.ones(n_frames)) @ coefficients
    found *= np.exp(curve(np.clip(frames, instants[known][0], instants[known][-1])))
    return np.maximum(found, 0), np.interp(frames, instants, std) / np.sqrt(len(instants) / 8), frequency


def _waves(instants: FloatArray, frequency: float, lengths: FloatArray) -> FloatArray:
    """Return a constant and the harmonics of a frequency, averaged over spans: (S, 1 + 2 * 3)."""
    columns = [np.ones(len(instants))]
    for harmonic in range(1, _HARMONICS + 1):
        turns = harmonic * frequency * instants
        averaged = np.sinc(harmonic * frequency * lengths)
        if harmonic > 1 and harmonic * frequency * float(np.median(lengths)) > 0.5:
            averaged = np.zeros_like(averaged)
        columns += [averaged * np.cos(2 * np.pi * turns), averaged * np.sin(2 * np.pi * turns)]
    return np.stack(columns, axis=1)


def _residual(instants: FloatArray, series: FloatArray, slow: FloatArray, frequency: float) -> float:
    """Return the residual sum of squares of a fit of a wave of one frequency and a slow curve."""
    turns = 2 * np.pi * frequency * instants[:, None]
    columns = np.concatenate([slow, np.cos(turns), np.sin(turns)], axis=1)
    return float(((series - columns @ np.linalg.lstsq(columns, series)[0]) ** 2).sum())


def _smooth(instants: FloatArray, values: FloatArray, std: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the smoothest cubic curve that fits values within their noise; of fewer than four values, lines between them."""
    if len(values) < 4:
        return lambda at: np.interp(at, instants, values)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a closer fit was not found in its limit of steps
        return UnivariateSpline(instants, values, w=1 / np.maximum(std, 1e-4), k=3, s=len(values))
