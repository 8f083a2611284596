"""Measure light that flickers at one frequency, with amplitude and phase of its own at each place of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from photonpano.corrections.lighting.gains import SMOOTHING, STRUCTURE, Gains, SeenCells
from photonpano.robust import robust_std
from photonpano.values import FloatArray, FluxImage

_PERIODS = 1.2  # periods for which a place must be in view
_FINER = 3  # oversampling of frequency: steps per 1/T, where a place is in view for T
_STANDS_OUT = 3.0  # what a flicker explains at least, relative to the median over frequencies
_BETTER = 0.7  # of what one gain for all of the scene leaves, what a flicker of places leaves at most
_ACCURACY = 1e-3  # of the frequency, relative to it
_LEAST_INFORMATION = 0.05  # prior of the waves of a place, relative to its photons: it matters if a place is in view briefly
_SMALLEST = 0.05  # least root mean square, over places and time, of a flicker that is divided out
_SPREAD = 0.5  # prior standard deviation of the amplitudes
_NEIGHBOURHOODS = (32.0, 16.0, 8.0, 4.0)  # standard deviations of Gaussians, in squares: lamps have no sharp borders
_DIFFERENCE = 0.2  # prior standard deviation of the amplitudes in a neighbourhood, relative to the next larger one
_LEAST_GAIN = 0.05  # of a place: lamps hardly go out
# Standard deviation of the Gaussian over which a flicker has one phase; brightness that a tremor changes has not.
_ALIKE_CELLS = 3.0
_ROUNDS = 3  # of fitting amplitudes and slow changes of the light in turn
_MOST = 1.5  # largest amplitude, relative to the mean light of a place


@dataclass(frozen=True, slots=True, eq=False)
class LocalFlicker:
    """The flicker of each square of the scene: `1 + cosine cos(2 pi f t) + sine sin(2 pi f t)` of its mean light."""

    frequency: float  # f, in cycles per frame
    maps: FluxImage  # (2, h, w) float32, cosine and sine
    slow: FloatArray  # (S,) gain of the spans, over which it does not flicker


def local_flicker(gains: Gains) -> LocalFlicker | None:
    """Return the flicker of places, each at its own phase; None if no frequency stands out, or all places flicker alike.

    What a wave explains is added up over all squares, whatever its phase there. A square is in view for a short time only, in
    which few waves tell a flicker from a slow change: it has to explain more than its neighbours in frequency do, and together
    with the phases more than one gain for all of the scene does.
    """
    seen = gains.seen
    instants = seen.instants
    if not len(seen.cells):
        return None
    first, last = np.full(seen.n_cells, np.inf), np.full(seen.n_cells, -np.inf)
    np.minimum.at(first, seen.cells, instants[seen.times])
    np.maximum.at(last, seen.cells, instants[seen.times])
    duration = max(1.0, float(np.median((last - first)[seen.cells])))
    length = float(np.median([len(span) for span in seen.spans]))
    highest = 1 / max(4 * length, 2.0 * (instants[-1] - instants[0]) / (4 * len(instants)))
    frequencies = np.arange(_PERIODS / duration, highest, 1 / (_FINER * duration))
    if len(frequencies) < 8 or duration < 8 * length:
        return None
    ratio, weight = _relative(gains)
    series, weights = _of_neighbours(seen, weight * ratio), _of_neighbours(seen, weight)
    found = [_explained(series, weights, instants, each) for each in frequencies]
    peak = int(np.argmax(found))
    # Of a wave of amplitude a, this is a^2 / 2.
    smallest = max(_STANDS_OUT * float(np.median(found)), _SMALLEST**2)
    if peak in (0, len(found) - 1) or found[peak] < smallest:
        return None
    near = float(frequencies[peak - 1]), float(frequencies[peak + 1])
    best = minimize_scalar(partial(_misfit, gains), bounds=near, options={"xatol": _ACCURACY * near[0]})
    flicker = measured_flicker(gains, float(best.x))
    alike = replace(flicker, maps=np.zeros_like(flicker.maps), slow=gains.gain)
    # Medians, since things that move change the light of their places, too.
    left, common = (robust_std(_left(gains, each)[0]) ** 2 for each in (flicker, alike))
    noise = float(np.median(_left(gains, flicker)[1]))
    # Of light that is the same everywhere, one gain leaves as little as places do.
    is_local = common - left > max((1 - _BETTER) * (common - noise), (_SMALLEST / 2) ** 2)
    return flicker if is_local else None


def _explained(series: FloatArray, weights: FloatArray, instants: FloatArray, frequency: float) -> float:
    """Return the mean square that waves of a frequency explain in (C, S) weighted series, each with a mean of its own."""
    turns = 2 * np.pi * frequency * instants
    columns = np.stack([np.ones(len(turns)), np.cos(turns), np.sin(turns)])
    right = series @ columns.T
    normal = (weights @ (columns[:, None] * columns).reshape(9, -1).T).reshape(-1, 3, 3)
    total = np.maximum(normal[:, 0, 0], 1e-12)
    normal[:, [1, 2], [1, 2]] += _LEAST_INFORMATION * total[:, None]
    normal[:, [0, 1, 2], [0, 1, 2]] += 1e-12
    waves = np.linalg.solve(normal, right[..., None])[..., 0]
    return float(((waves * right).sum(axis=1) - right[:, 0] ** 2 / total).sum() / total.sum())


def _of_neighbours(seen: SeenCells, values: FloatArray) -> FloatArray:
    """Return the values of the observations, each shared among neighbours that flicker alike: (C, S)."""
    found = np.zeros((len(seen.spans), seen.n_cells))
    found[seen.times, seen.cells] = values
    for row in found:
        row[:] = cv2.GaussianBlur(row.reshape(seen.canvas.shape), (0, 0), _ALIKE_CELLS, borderType=cv2.BORDER_CONSTANT).ravel()
    return found.T


def _misfit(gains: Gains, frequency: float) -> float:
    """Return the mean square that a flicker of a frequency leaves in the photons."""
    left, noise = _left(gains, measured_flicker(gains, frequency))
    return float(np.average(left**2, weights=1 / (SMOOTHING**2 * noise + STRUCTURE**2)))


def _left(gains: Gains, flicker: LocalFlicker) -> tuple[FloatArray, FloatArray]:
    """Return what a flicker leaves of the photons, relative to what it predicts, and its variance by noise: (N,) each."""
    expected, _ = _lit(gains, _waves(gains.seen, flicker.frequency), flicker.maps.astype(float), flicker.slow)
    return gains.seen.photons / expected - 1, 1 / expected / SMOOTHING**2


def _waves(seen: SeenCells, frequency: float) -> FloatArray:
    """Return cosine and sine of each observation, averaged over its span: (2, N)."""
    turns = 2 * np.pi * frequency * seen.instants
    averaged = np.sinc(frequency * np.array([len(span) for span in seen.spans], float))
    return np.asarray((averaged * np.stack([np.cos(turns), np.sin(turns)]))[:, seen.times])


def measured_flicker(gains: Gains, frequency: float) -> LocalFlicker:
    """Fit the amplitude and the phase of each square of the scene at a frequency; spans must be much shorter than a period."""
    seen, waves = gains.seen, _waves(gains.seen, frequency)
    period = max(1, round(1 / (frequency * float(np.median(np.diff(seen.instants))))))
    amplitudes, slow = np.zeros((2, *seen.canvas.shape)), np.ones(len(seen.spans))
    for _ in range(_ROUNDS):
        amplitudes = _amplitudes(seen, waves, *_lit(gains, waves, amplitudes, slow))
        expected, _ = _lit(gains, waves, amplitudes, slow)
        steady = expected / slow[seen.times]
        photons, sums = (
            _running(np.bincount(seen.times, each, len(slow)).astype(float), period) for each in (seen.photons, steady)
        )
        slow = np.maximum(photons / np.maximum(sums, 1e-12), 1e-3)
        slow = slow / slow.mean()
    return LocalFlicker(frequency, np.clip(amplitudes, -_MOST, _MOST).astype(np.float32), slow)


def _lit(gains: Gains, waves: FloatArray, amplitudes: FloatArray, slow: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how many photons each observation has in this light, and its gain in the light of its place: (N,) each."""
    seen = gains.seen
    gain = np.maximum(1 + (amplitudes.reshape(2, -1)[:, seen.cells] * waves).sum(axis=0), _LEAST_GAIN)
    lit = seen.exposure * gain * slow[seen.times] * np.exp(gains.shifted)
    photons, exposure = (np.bincount(seen.cells, each, seen.n_cells) for each in (seen.photons, lit))
    return np.maximum(lit * (photons / np.maximum(exposure, 1e-12))[seen.cells], 1e-12), gain


def _amplitudes(seen: SeenCells, waves: FloatArray, expected: FloatArray, gain: FloatArray) -> FloatArray:
    """Return the amplitudes of cosine and sine of each square: (2, h, w).

    The brightness of a square is not known beside its amplitudes: where it is in view for a part of a period, its photons tell
    little, and its neighbours decide. Amplitudes are those of a wide neighbourhood, unless the photons of a smaller one differ.
    """
    ratio, weight = seen.photons * gain / expected, 1 / (gain**2 / expected + (STRUCTURE * gain) ** 2)
    total = np.maximum(np.bincount(seen.cells, weight, seen.n_cells), 1e-12)
    cosine, sine, left = (
        each - (np.bincount(seen.cells, weight * each, seen.n_cells) / total)[seen.cells] for each in (*waves, ratio)
    )
    products = cosine * cosine, cosine * sine, sine * sine, cosine * left, sine * left
    sums = [np.bincount(seen.cells, weight * each, seen.n_cells).reshape(seen.canvas.shape) for each in products]
    found, prior = np.zeros((2, *seen.canvas.shape)), 1 / _SPREAD**2
    for size in _NEIGHBOURHOODS:
        cc, cs, ss, rc, rs = (cv2.GaussianBlur(each, (0, 0), size, borderType=cv2.BORDER_CONSTANT) for each in sums)
        cc, ss, rc, rs = cc + prior, ss + prior, rc + prior * found[0], rs + prior * found[1]
        found = np.stack([ss * rc - cs * rs, cc * rs - cs * rc]) / (cc * ss - cs**2)
        prior = 1 / _DIFFERENCE**2
    return found


def _relative(gains: Gains) -> tuple[FloatArray, FloatArray]:
    """Return what each observation has beyond its square, as a fraction, and its weight: (N,) each."""
    seen = gains.seen
    expected = seen.exposure * np.exp(np.nan_to_num(gains.brightness)[seen.cells] + gains.shifted)
    ratio = np.clip(seen.photons / np.maximum(expected, 1e-12) - 1, -2, 2)
    return ratio, 1 / (1 / np.maximum(expected, 1e-12) + STRUCTURE**2)


def _running(values: FloatArray, length: int) -> FloatArray:
    """Return the mean over windows of this length, shorter ones at the ends."""
    kernel = np.ones(min(length, len(values)))
    return np.asarray(np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same"))
