"""Measure light that flickers at one frequency, with amplitude and phase of its own at each place of the scene."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from photonpano.corrections.lighting.gains import STRUCTURE, Gains, SeenCells, equations_of_groups
from photonpano.values import FloatArray, FluxImage

_PERIODS = 2.5  # periods for which a place must be in view
_FINER = 3  # oversampling of frequency: steps per 1/T, where a place is in view for T
_STANDS_OUT = 3.0  # least power of a flicker, relative to the median over frequencies
_LINE = 10.0  # least power of a line in the spectrum of the light of all of the scene, relative to the median nearby
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

    The power of all squares is added up, whatever their phase. A square is in view for a short time only, which limits the
    resolution of the frequency.
    """
    seen = gains.seen
    instants = seen.instants
    ratio, weight = _relative(gains)
    known = seen.n_cells, len(seen.spans)
    first, last = np.full(known[0], np.inf), np.full(known[0], -np.inf)
    np.minimum.at(first, seen.cells, instants[seen.times])
    np.maximum.at(last, seen.cells, instants[seen.times])
    duration = float(np.median((last - first)[last >= first]))
    length = float(np.median([len(span) for span in seen.spans]))
    highest = 1 / max(4 * length, 2.0 * (instants[-1] - instants[0]) / (4 * len(instants)))
    frequencies = np.arange(_PERIODS / max(duration, 1.0), highest, 1 / (_FINER * max(duration, 1.0)))
    if len(frequencies) < 8 or duration < 8 * length:
        return 0.0
    # A square whose mean is not subtracted would have power at all frequencies.
    series, weights = _of_neighbours(seen, weight * ratio), _of_neighbours(seen, weight)
    total = np.maximum(weights.sum(axis=1), 1e-12)
    series -= weights * (series.sum(axis=1) / total)[:, None]

    def power(each: FloatArray) -> FloatArray:
        waves = np.exp(-2j * np.pi * np.outer(instants, each))
        return np.asarray((np.abs(series @ waves) ** 2 / total[:, None]).sum(axis=0))

    found = power(frequencies)
    peak = int(found.argmax())
    near = frequencies[peak] + np.linspace(-1, 1, 17) / (_FINER * duration)
    best = float(near[int(power(near).argmax())])
    excess = float(found[peak] - np.median(found))
    # Of a wave of amplitude a, this power is a^2 / 4 for each unit of weight.
    if found[peak] < _STANDS_OUT * float(np.median(found)) or 2 * excess / weight.sum() < _SMALLEST**2:
        return 0.0
    return best if _is_local(gains, _of_all(gains, best, 1 / duration)) else 0.0


def _of_all(gains: Gains, frequency: float, within: float) -> float:
    """Return the frequency of the light of all of the scene near another one; that one, if no line stands out.

    The resolution of the whole capture is higher than that of the time for which a square is in view. At a wrong frequency, the
    phase of uniform light seems to differ from place to place.
    """
    instants = gains.seen.instants
    step = 1 / (8 * (instants[-1] - instants[0]))
    frequencies = np.arange(max(frequency - within, step), frequency + within, step)
    power = np.abs(np.exp(-2j * np.pi * np.outer(frequencies, instants)) @ (gains.gain - gains.gain.mean())) ** 2
    peak = int(power.argmax())
    return float(frequencies[peak]) if power[peak] > _LINE * np.median(power) else frequency


def _of_neighbours(seen: SeenCells, values: FloatArray) -> FloatArray:
    """Return the values of the observations, each shared among neighbours that flicker alike: (C, S)."""
    found = np.zeros((len(seen.spans), seen.n_cells))
    found[seen.times, seen.cells] = values
    for row in found:
        row[:] = cv2.GaussianBlur(row.reshape(seen.shape), (0, 0), _ALIKE_CELLS, borderType=cv2.BORDER_CONSTANT).ravel()
    return found.T


def _is_local(gains: Gains, frequency: float) -> bool:
    """Return whether amplitude or phase of the flicker at a frequency differ from place to place."""
    flicker = measure_local_flicker(gains, frequency)
    seen = np.bincount(gains.seen.cells, gains.seen.photons, gains.seen.n_cells).reshape(gains.seen.shape)
    wave = flicker.cosine - 1j * flicker.sine
    mean = (seen * wave).sum() / seen.sum()
    scatter = float(np.sqrt((seen * np.abs(wave - mean) ** 2).sum() / seen.sum() / 2))
    return scatter > _SMALLEST


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
        image = np.bincount(seen.cells, weight * values, seen.n_cells).reshape(seen.shape)
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
