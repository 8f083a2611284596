"""Measure light that flickers at one frequency, with amplitude and phase of its own at each place of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize_scalar

from photonpano.corrections.lighting.gains import SMOOTHING, STRUCTURE, Gains, SeenCells, equations_of_groups
from photonpano.values import FloatArray, FluxImage

_PERIODS = 1.2  # periods for which a place must be in view
_FINER = 3  # oversampling of frequency: steps per 1/T, where a place is in view for T
_STANDS_OUT = 3.0  # what a flicker explains at least, relative to the median over frequencies
_BETTER = 0.7  # of what one gain for all of the scene leaves, what a flicker of places leaves at most
_ACCURACY = 1e-3  # of the frequency, relative to it
_LEAST_INFORMATION = 0.05  # prior of the waves of a place, relative to its photons: it matters if a place is in view briefly
_SMALLEST = 0.05  # least root mean square, over places and time, of a flicker that is divided out
_SPREAD = 0.5  # prior standard deviation of the amplitudes
_SMOOTH_CELLS = 1.0  # standard deviation of the Gaussian that smooths the amplitudes: lamps have no sharp borders
# Standard deviation of the Gaussian over which a flicker has one phase; brightness that a tremor changes has not.
_ALIKE_CELLS = 3.0
_ROUNDS = 2  # of fitting amplitudes and slow changes of the light in turn
_MOST = 1.5  # largest amplitude, relative to the mean light of a place


@dataclass(frozen=True, slots=True, eq=False)
class LocalFlicker:
    """The flicker of each square of the scene: `1 + cosine cos(2 pi f t) + sine sin(2 pi f t)` of its mean light."""

    frequency: float  # f, in cycles per frame
    cosine: FluxImage  # (h, w) float32
    sine: FluxImage  # (h, w) float32
    slow: FloatArray  # (S,) gain of the spans, over which it does not flicker


def local_frequency(gains: Gains) -> float:
    """Return the frequency at which places flicker, each at its own phase, in cycles per frame; 0 if none stands out.

    What a wave explains is added up over all squares, whatever its phase there. A square is in view for a short time only, in
    which few waves tell a flicker from a slow change: it has to explain more than its neighbours in frequency do, and together
    with the phases more than one gain for all of the scene does.
    """
    seen = gains.seen
    instants = seen.instants
    first, last = np.full(seen.n_cells, np.inf), np.full(seen.n_cells, -np.inf)
    np.minimum.at(first, seen.cells, instants[seen.times])
    np.maximum.at(last, seen.cells, instants[seen.times])
    duration = max(1.0, float(np.median((last - first)[seen.cells])))
    length = float(np.median([len(span) for span in seen.spans]))
    highest = 1 / max(4 * length, 2.0 * (instants[-1] - instants[0]) / (4 * len(instants)))
    frequencies = np.arange(_PERIODS / duration, highest, 1 / (_FINER * duration))
    if len(frequencies) < 8 or duration < 8 * length:
        return 0.0
    ratio, weight = _relative(gains)
    series, weights = _of_neighbours(seen, weight * ratio), _of_neighbours(seen, weight)
    found = [_explained(series, weights, instants, each) for each in frequencies]
    peak = int(np.argmax(found))
    # Of a wave of amplitude a, this is a^2 / 2.
    smallest = max(_STANDS_OUT * float(np.median(found)), _SMALLEST**2)
    if peak in (0, len(found) - 1) or found[peak] < smallest:
        return 0.0
    near = float(frequencies[peak - 1]), float(frequencies[peak + 1])
    best = minimize_scalar(lambda each: _left_of_places(gains, each)[0], bounds=near, options={"xatol": _ACCURACY * near[0]})
    left, noise = _left_of_places(gains, float(best.x))
    common, _ = _left(gains, gains.gain[seen.times])
    # Of light that is the same everywhere, one gain leaves as little as places do.
    is_local = common - left > max((1 - _BETTER) * (common - noise), (_SMALLEST / 2) ** 2)
    return float(best.x) if is_local else 0.0


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


def _left_of_places(gains: Gains, frequency: float) -> tuple[float, float]:
    """Return what a flicker of places leaves in the photons; see `_left`."""
    seen, flicker = gains.seen, measure_local_flicker(gains, frequency)
    turns = 2 * np.pi * frequency * seen.instants
    waves = np.cos(turns)[seen.times], np.sin(turns)[seen.times]
    of_place = 1 + sum(
        each.ravel()[seen.cells] * wave for each, wave in zip((flicker.cosine, flicker.sine), waves, strict=True)
    )
    return _left(gains, of_place * flicker.slow[seen.times])


def _left(gains: Gains, light: FloatArray) -> tuple[float, float]:
    """Return the mean square that (N,) light leaves in the photons, relative to them, and that of their noise."""
    seen = gains.seen
    lit = seen.exposure * np.exp(gains.shifted) * np.maximum(light, 1e-3)
    photons, exposure = (np.bincount(seen.cells, each, seen.n_cells) for each in (seen.photons, lit))
    expected = np.maximum(lit * (photons / np.maximum(exposure, 1e-12))[seen.cells], 1e-12)
    weight = 1 / (1 / expected + STRUCTURE**2)
    left, noise = (seen.photons / expected - 1) ** 2, 1 / expected / SMOOTHING**2
    return float((weight * left).sum() / weight.sum()), float((weight * noise).sum() / weight.sum())


def measure_local_flicker(gains: Gains, frequency: float) -> LocalFlicker:
    """Fit the amplitude and the phase of each square of the scene at a frequency; spans must be much shorter than a period."""
    seen = gains.seen
    lengths = np.array([len(span) for span in seen.spans], float)
    phase = 2 * np.pi * frequency * seen.instants
    averaged = np.sinc(frequency * lengths)
    waves = np.stack([np.ones(len(phase)), averaged * np.cos(phase), averaged * np.sin(phase)])
    period = max(1, round(1 / (frequency * float(np.median(np.diff(seen.instants))))))
    slow = np.ones(len(seen.spans))
    for _ in range(_ROUNDS):
        coefficients = _fitted(seen, waves, slow)
        expected = seen.exposure * (coefficients[seen.cells] * waves.T[seen.times]).sum(axis=1)
        photons, sums = (
            np.bincount(seen.times, each, len(slow)).astype(float) for each in (seen.photons, np.maximum(expected, 0))
        )
        slow = np.maximum(_running(photons, period) / np.maximum(_running(sums, period), 1e-12), 1e-3)
        slow = slow / slow.mean()
    brightness = coefficients[:, 0]
    cosine, sine = _smoothed(seen, waves, slow, brightness)
    return LocalFlicker(frequency, cosine, sine, slow)


def _relative(gains: Gains) -> tuple[FloatArray, FloatArray]:
    """Return what each observation has beyond its square, as a fraction, and its weight: (N,) each."""
    seen = gains.seen
    expected = seen.exposure * np.exp(np.nan_to_num(gains.brightness)[seen.cells] + gains.shifted)
    ratio = np.clip(seen.photons / np.maximum(expected, 1e-12) - 1, -2, 2)
    return ratio, 1 / (1 / np.maximum(expected, 1e-12) + STRUCTURE**2)


def _fitted(seen: SeenCells, waves: FloatArray, slow: FloatArray) -> FloatArray:
    """Return mean, cosine and sine of the flux of each square: (C, 3)."""
    flux = np.bincount(seen.cells, seen.photons, seen.n_cells) / np.maximum(
        np.bincount(seen.cells, seen.exposure * slow[seen.times], seen.n_cells), 1e-12
    )
    flux = np.maximum(flux, 1e-9)
    exposure = seen.exposure * slow[seen.times]
    weight = 1 / (flux[seen.cells] / exposure + (STRUCTURE * flux[seen.cells]) ** 2)
    columns = waves[:, seen.times]
    normal, right = equations_of_groups(seen.cells, seen.n_cells, columns, weight, seen.photons / exposure)
    normal[:, 0, 0] += 1e-12
    for i in (1, 2):
        normal[:, i, i] += 1 / (_SPREAD * flux) ** 2
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _smoothed(seen: SeenCells, waves: FloatArray, slow: FloatArray, brightness: FloatArray) -> tuple[FluxImage, FluxImage]:
    """Return the amplitudes of cosine and sine, relative to the brightness of each square: (h, w) each."""
    flux = np.maximum(brightness[seen.cells], 1e-9)
    exposure = seen.exposure * slow[seen.times]
    ratio = seen.photons / (exposure * flux) - 1
    weight = 1 / (1 / (exposure * flux) + STRUCTURE**2)
    cosine, sine = waves[1, seen.times], waves[2, seen.times]

    def shared(values: FloatArray) -> FloatArray:
        image = np.bincount(seen.cells, weight * values, seen.n_cells).reshape(seen.canvas.shape)
        return np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTH_CELLS, borderType=cv2.BORDER_CONSTANT))

    cc, cs, ss = shared(cosine * cosine), shared(cosine * sine), shared(sine * sine)
    rc, rs = shared(ratio * cosine), shared(ratio * sine)
    cc, ss = cc + 1 / _SPREAD**2, ss + 1 / _SPREAD**2
    determinant = cc * ss - cs**2
    amplitudes = (ss * rc - cs * rs) / determinant, (cc * rs - cs * rc) / determinant
    first, second = (np.clip(each, -_MOST, _MOST).astype(np.float32) for each in amplitudes)
    return first, second


def _running(values: FloatArray, length: int) -> FloatArray:
    """Return the mean over windows of this length, shorter ones at the ends."""
    kernel = np.ones(min(length, len(values)))
    return np.asarray(np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same"))
