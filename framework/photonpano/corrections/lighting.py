"""Find out along the motion whether the light of a capture changes, and measure it for each frame, and the gain of pixels."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import UnivariateSpline

from photonpano.capture import capture_of, in_light
from photonpano.contracts.protocols import Source, Trajectory, light_of
from photonpano.corrections.gains import (
    SMOOTHING,
    STRUCTURE,
    Gains,
    LocalFlicker,
    SeenCells,
    local_flicker,
    seen_cells,
    solve_gains,
)
from photonpano.corrections.geometry import speed_px
from photonpano.errors import InputError
from photonpano.execution.context import Context
from photonpano.geometry import inverse
from photonpano.reading import reading
from photonpano.values import Decision, FloatArray, FluxImage, FrameSpan, Light

# Least root mean square of changes of the light, between instants that see the same places, that are divided out.
LEAST_CHANGE = 0.03
_LEAST_SIGMAS = 3.0  # least ratio of these changes to their noise
_PROBES, _PROBE_FRAMES = 128, 16  # spans all over the capture, and frames of each, that are compared to find out
_MOST_SPANS, _FEWEST_FRAMES = 640, 4  # most spans, and fewest frames of each, with which the light is measured
_SPAN_PX = 4.0  # the image moves by no more than this in a span
_HARMONICS = 3  # harmonics of a flicker that are fitted
_FEWEST_PERIODS, _FEWEST_SPANS = 2.5, 32  # of the capture, for a flicker to be searched for
_FINER = 16  # oversampling of frequency: steps per 1/T, for a capture of the duration T
_LINE_SHARE = 0.6  # least share of the changes of the light, without a slow curve, that a flicker explains
_SMALLEST = 0.01  # least root mean square of a flicker, relative to the light
_BRIGHTEST = 0.9  # quantile of the gain from which on frames are in the brightest light
_DARKEST = 0.02  # least gain of spans from which slow changes are fitted
LIGHT_FILE = "light.npz"
# The last three only where they are known.
_ARRAYS = "gain", "waves", "maps", "to_map", "frequency", "std", "camera_matrix", "tints", "std_tints"
_FLAT_SPANS, _FLAT_SPAN_PX = 128, 4.0  # most spans of frames that are compared; the image moves by no more than this in each
_KNOTS_ACROSS = 12  # knots of the gain along the shorter side of a frame; between them, its logarithm is bilinear
_LENGTH = 0.5  # distance over which knots are correlated, relative to the shorter side of a frame
_WIDEST = 1.0  # prior standard deviation of the logarithm of the gain
# Rounds of least squares, in which noise and spread of the gain are measured. Outliers keep their weight: counts of few
# photons are skewed, and down-weighting would bias their mean.
_ROUNDS = 4
# Standard deviation of the logarithm of the light before it is measured, and the least. A gain that falls along x and light
# that changes as the image shifts look alike, so that the light changes by no more than the gain leaves over.
_STEADY, _STEADIEST = 0.03, 1e-3
_LEAST_KNOWN = 0.5  # least share of the prior variance of the gain that photons and motion must remove
_NARROWEST = 1e-3  # least standard deviation of the prior


def find_light(source: Source, trajectory: Trajectory, context: Context) -> Light | None:
    """Measure the light of a capture along its motion, known to a few pixels; None if it is steady."""
    n_frames = source.info.n_frames
    longest = max(1, min(_PROBE_FRAMES, int(_SPAN_PX / max(speed_px(source, trajectory), 1e-9)), n_frames // _PROBES))
    spans = _spread(n_frames, longest)
    gains = _gains(source, trajectory, spans, context)
    if changes(gains) or local_flicker(gains) is not None:
        return measure_light(source, trajectory, context)
    coloured = any(changes(_gains(each, trajectory, spans, context)) for each in capture_of(source).colours().values())
    return measure_light(source, trajectory, context) if coloured else None


def changes(gains: Gains) -> bool:
    """Return whether the changes of the light exceed those of steady light, and noise."""
    return gains.change > max(LEAST_CHANGE, _LEAST_SIGMAS * float(np.median(gains.std)))


def measure_light(source: Source, trajectory: Trajectory, context: Context) -> Light:
    """Measure the gain of each frame of a capture along its motion, known to a few pixels; frames left out stay so."""
    light, before = _measured(source, trajectory, context), light_of(source)
    return light if before is None else light.leaving_out(before.shown)


def _measured(source: Source, trajectory: Trajectory, context: Context) -> Light:
    n_frames = source.info.n_frames
    length = min(n_frames, max(_FEWEST_FRAMES, -(-n_frames // _MOST_SPANS)))
    bounds = np.linspace(0, n_frames, max(1, n_frames // length) + 1).astype(int).tolist()
    spans = [FrameSpan(*pair) for pair in pairwise(bounds)]
    gains = _gains(source, trajectory, spans, context)
    if (flicker := local_flicker(gains)) is not None:
        light = _light_of(flicker, gains, n_frames)
    else:
        gain, std, frequency = _of_frames(gains, gains.gain, n_frames)
        mean = float(gain.mean())
        light = Light.of_frames(gain / mean, frequency, std / mean)
    of_colours = [_gains(each, trajectory, spans, context) for each in capture_of(source).colours().values()]
    return _tinted(light, of_colours) if of_colours else light


def _tinted(light: Light, of_colours: Sequence[Gains]) -> Light:
    """Return light in which each colour has a gain of its own, as where a lamp of one colour goes out.

    The colours of the panorama are those in the brightest light, in which most lamps are on.
    """
    n_frames, tints, std_tints = len(light.gain), [], []
    brightest = light.gain >= np.quantile(light.gain, _BRIGHTEST) - light.std
    for gains in of_colours:
        of_all = np.array([light.mean(span) for span in gains.seen.spans])
        tint, std, _ = _of_frames(gains, gains.gain / np.maximum(of_all, _DARKEST), n_frames)
        full = float(tint[brightest].mean())
        tints.append(tint / full)
        std_tints.append(std / full)
    return replace(light, tints=np.array(tints), std_tints=np.array(std_tints))


def _of_frames(gains: Gains, of_spans: FloatArray, n_frames: int) -> tuple[FloatArray, FloatArray, float]:
    """Return what `gain_of_frames` does of the gains of spans."""
    lengths = np.array([len(span) for span in gains.seen.spans], float)
    return gain_of_frames(gains.seen.instants, of_spans, gains.std, lengths, n_frames)


def corrected_light(light: Light, spans: Sequence[FrameSpan], change: FloatArray, std: FloatArray) -> Light:
    """Correct light by the (S,) changes of spans that the panorama rendered in it does not explain, with standard deviations.

    A change is the brightness of a span relative to that of the panorama in this light, minus 1. Squares of the scene are
    brighter and darker inside, so that a sensor that saturates sees too little of their changes; a panorama has every pixel.
    Lamps over parts of the scene stay as they are.
    """
    if light.has_lamps:
        return light
    kept = [bool(light.shown[span.start : span.stop].all()) for span in spans]
    spans, change, std = [span for span, each in zip(spans, kept, strict=True) if each], change[kept], std[kept]
    instants = np.array([span.centre for span in spans])
    lengths = np.array([len(span) for span in spans], float)
    gain = np.array([light.mean(span) for span in spans]) * np.maximum(1 + change, 0)
    found, noise, frequency = gain_of_frames(instants, gain, std, lengths, len(light.gain))
    if bool(frequency) != bool(light.frequency):
        return light
    mean = float(found.mean())
    corrected = Light.of_frames(found / mean, frequency, noise / mean).leaving_out(light.shown)
    return replace(corrected, tints=light.tints, std_tints=light.std_tints)


def _light_of(flicker: LocalFlicker, gains: Gains, n_frames: int) -> Light:
    """Return the light of each frame, which flickers differently at each place."""
    frames = np.arange(n_frames)
    slow, std = (np.interp(frames, gains.seen.instants, each) for each in (flicker.slow, gains.std))
    phase = 2 * np.pi * flicker.frequency * frames
    waves, canvas = np.stack([np.cos(phase), np.sin(phase)]), gains.seen.canvas
    camera_matrix = None if canvas.planar else canvas.camera_matrix
    return Light(
        gain=slow / slow.mean(),
        waves=waves,
        maps=flicker.maps,
        to_map=canvas.transform,
        frequency=flicker.frequency,
        std=std,
        camera_matrix=camera_matrix,
    )


def decision_of(light: Light, frame_rate_hz: float | None) -> Decision:
    """Return what was found, for the record: the depth of the changes, and the frequency of a flicker."""
    gains = light.gain * (1 if light.tints is None else light.tints)
    low, high = (float(np.quantile(gains[..., light.shown], each)) for each in (0.01, 0.99))
    depth = (high - low) / (high + low)
    of = "scene" if light.tints is None else "scene, in each colour by itself,"
    where = f"the light of the {of} changes between {low:.2f} and {high:.2f} of its mean"
    if light.has_lamps:
        depth = float(np.quantile(np.hypot(*light.maps), 0.9))
        where = f"lamps over parts of the scene, each at its own phase, flicker by up to {depth:.2f} of the mean light"
    if light.frequency:
        period = f"with a period of {1 / light.frequency:.4g} frames"
        where += f", {period}" if frame_rate_hz is None else f", at {light.frequency * frame_rate_hz:.2f} Hz"
    return Decision("light", round(depth, 3), where)


def _gains(source: Source, trajectory: Trajectory, spans: list[FrameSpan], context: Context) -> Gains:
    return solve_gains(seen_cells(source, trajectory, spans, context))


def _spread(n_frames: int, length: int) -> list[FrameSpan]:
    """Return spans all over the capture, at uneven distances, so that no flicker has their period."""
    even = np.linspace(0, n_frames - length, min(_PROBES, n_frames // length))
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(even)) * max(n_frames / _PROBES - length, 0)
    starts = np.clip(even + jitter, 0, n_frames - length).astype(int)
    return [FrameSpan(start, start + length) for start in np.unique(starts).tolist()]


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

    Given are the (S,) centres of spans, in frames, their mean gains, the standard deviations of the logarithms of these, and
    the frames of each span, over which a flicker is averaged.
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
        # In the dark of a lamp that is switched, harmonics err by more than noise.
        misfit = float(np.sqrt(np.mean((gain - slow * model) ** 2)))
        curve = _smooth(instants[known], ratio, np.hypot(std[known], misfit) / np.minimum(1, model[known]))
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


def write_light(folder: Path, light: Light) -> None:
    """Write light.npz into a folder."""
    arrays: dict[str, Any] = {name: getattr(light, name) for name in _ARRAYS if getattr(light, name) is not None}
    np.savez(folder / LIGHT_FILE, **arrays)


def in_light_of(source: Source, folder: Path) -> Source:
    """Return a capture in the light that a run folder holds; as it is, if the run found steady light.

    Raises an `InputError` if light.npz is damaged, or of a capture with another number of frames.
    """
    path = folder / LIGHT_FILE
    if not path.exists():
        return source
    with reading(path, "cannot be read as the light of a run; run again"), np.load(path, allow_pickle=False) as archive:
        arrays: dict[str, Any] = {name: archive[name] for name in _ARRAYS if name in archive}
        light = Light(**{**arrays, "frequency": float(arrays["frequency"])})
    if len(light.gain) != source.info.n_frames:
        raise InputError(
            f"{path} is the light of {len(light.gain)} frames, but the capture has {source.info.n_frames}; run again"
        )
    return in_light(source, light)


@dataclass(frozen=True, slots=True, eq=False)
class PixelGain:
    """The relative gain of the pixels of a sensor."""

    gain: FluxImage  # (H, W) float32, 1 on average over the valid pixels
    # (H, W) float32, its standard deviation, relative to the gain. It contains what the motion leaves open: of a picture that
    # turns, how the gain changes with the distance from the centre of the turn.
    std: FluxImage
    spans: tuple[FrameSpan, ...]  # the frames that it was measured from


def measure_pixel_gain(source: Source, trajectory: Trajectory, context: Context) -> PixelGain:
    """Compare what different pixels saw of the same places, along a motion known to a few pixels.

    A square c of the scene sends `exposure exp(s_c + l_t + sum_k a_k b_k(x))` photons in the span t, in which it lies at the
    pixel x of the sensor. The knots a_k of the logarithm of the gain are found by iterated least squares, together with the
    light l_t; the brightness s_c is eliminated. Their prior is a Gaussian whose spread is that of the knots themselves, so that
    what the motion leaves open stays flat, as does the field of a sensor whose pixels are alike.

    Raises:
        InputError: the motion cannot tell the gain from the scene.
    """
    n_frames, shape = source.info.n_frames, source.info.frame_shape
    length = max(1, min(int(_FLAT_SPAN_PX / max(speed_px(source, trajectory), 1e-9)), n_frames // _FLAT_SPANS))
    starts = np.linspace(0, n_frames - length, min(_FLAT_SPANS, n_frames // length)).astype(int).tolist()
    spans = [FrameSpan(start, start + length) for start in starts]
    seen = seen_cells(source, trajectory, spans, context)
    knots = _Knots.of(shape)
    places = _on_sensor(seen, inverse(trajectory.at(seen.instants)))
    log_gain, variance = knots.image(*_solved(seen, knots.basis(places), knots.correlation()), source.valid)
    gain = np.exp(log_gain)
    gain /= gain[source.valid].mean()
    return PixelGain(gain.astype(np.float32), np.sqrt(variance).astype(np.float32), seen.spans)


def _on_sensor(seen: SeenCells, to_frames: FloatArray) -> FloatArray:
    """Return the pixel of the sensor that the middle of each observed square fell on: (N, 2)."""
    rows, columns = np.divmod(seen.cells, seen.canvas.width)
    places = np.empty((len(seen.cells), 2))
    middles = seen.canvas.on_plane(np.stack([columns, rows], axis=-1))
    for time, homography in enumerate(to_frames):
        of_time = seen.times == time
        x, y, depth = homography @ middles[of_time].T
        places[of_time] = np.stack([x / depth, y / depth], axis=-1)
    return places


@dataclass(frozen=True, slots=True)
class _Knots:
    """A grid of knots from corner to corner of the frame."""

    frame_shape: tuple[int, int]  # (height, width)
    shape: tuple[int, int]  # (rows, columns)

    @classmethod
    def of(cls, frame_shape: tuple[int, int]) -> _Knots:
        side = min(frame_shape) / (_KNOTS_ACROSS - 1)
        rows, columns = (round(length / side) + 1 for length in frame_shape)
        return cls(frame_shape, (rows, columns))

    def basis(self, places: FloatArray) -> Any:
        """Return what each knot adds to the logarithm of the gain at (N, 2) pixels: a sparse (N, K)."""
        per_px = (np.array(self.shape[::-1]) - 1) / (np.array(self.frame_shape[::-1]) - 1)
        at = np.clip(places * per_px, 0, np.array(self.shape[::-1]) - 1)
        low = np.minimum(np.floor(at), np.array(self.shape[::-1]) - 2).astype(int)
        x, y = (at - low).T
        index = low[:, 1] * self.shape[1] + low[:, 0]
        corners = [index, index + 1, index + self.shape[1], index + self.shape[1] + 1]
        shares = [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
        rows = np.tile(np.arange(len(places)), 4)
        size = len(places), self.shape[0] * self.shape[1]
        return sparse.csr_array((np.concatenate(shares), (rows, np.concatenate(corners))), shape=size)

    def correlation(self) -> FloatArray:
        """Return the correlation of knots before anything is known of them, exp(-distance / length): (K, K)."""
        rows, columns = np.indices(self.shape).reshape(2, -1)
        distance = np.hypot(rows[:, None] - rows, columns[:, None] - columns)
        return np.asarray(np.exp(-distance / (_LENGTH * (_KNOTS_ACROSS - 1))))

    def image(self, mean: FloatArray, covariance: FloatArray, valid: Any) -> tuple[FloatArray, FloatArray]:
        """Return the logarithm of the gain, 0 on average over valid pixels, and its variance: (H, W) each."""
        height, width = self.frame_shape
        rows = [self.basis(np.stack([np.arange(width), np.full(width, y)], axis=-1).astype(float)) for y in range(height)]
        average = sum(row.T @ seen.astype(float) for row, seen in zip(rows, valid, strict=True)) / valid.sum()
        centred = np.eye(len(mean)) - average
        mean, covariance = centred @ mean, centred @ covariance @ centred.T
        variance = [row.multiply(row @ covariance).sum(axis=1) for row in rows]
        return np.stack([row @ mean for row in rows]), np.maximum(np.stack(variance), 0)


def _solved(seen: SeenCells, basis: Any, correlation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Solve for the mean (K,) and covariance (K, K) of the knots, or raise an `InputError` if they stay unknown."""
    n_times, n_knots = len(seen.spans), basis.shape[1]
    root = np.linalg.cholesky(correlation)
    every, ones = np.arange(len(seen.cells)), np.ones(len(seen.cells))
    of_time = sparse.csr_array((ones, (every, seen.times)), shape=(len(every), n_times))
    to_cells = sparse.csr_array((ones, (seen.cells, every)), shape=(seen.n_cells, len(every)))
    columns = sparse.hstack([basis, of_time]).tocsr()
    photons = np.bincount(seen.cells, seen.photons, seen.n_cells)
    exposure = np.bincount(seen.cells, seen.exposure, seen.n_cells)
    brightness = np.log((photons + 0.5) / np.maximum(exposure, 1))
    unknowns = np.zeros(n_knots + n_times)
    spread_of_knots, light_std, noise = _WIDEST, _STEADY, 1.0
    for _ in range(_ROUNDS):
        expected = np.maximum(seen.exposure * np.exp(np.clip(brightness[seen.cells] + columns @ unknowns, -30, 30)), 1e-12)
        step = (seen.photons - expected) / expected
        weight = 1 / (1 / expected + STRUCTURE**2)
        weighted = columns.multiply(weight[:, None]).tocsr()
        of_cell = np.maximum(to_cells @ weight, 1e-12)
        mixed = (to_cells @ weighted).toarray()
        normal = (columns.T @ weighted).toarray() - mixed.T @ (mixed / of_cell[:, None])
        seen_step = to_cells @ (weight * step)
        right = weighted.T @ step - mixed.T @ (seen_step / of_cell)
        light = slice(n_knots, None)
        precision = (noise / light_std) ** 2
        normal[light, light] += precision * np.eye(n_times)
        right[light] -= precision * unknowns[light]
        # The light is eliminated, too.
        inner = np.linalg.solve(normal[light, light], np.column_stack([normal[light, :n_knots], right[light]]))
        information = (normal[:n_knots, :n_knots] - normal[:n_knots, light] @ inner[:, :-1]) / noise**2
        pull = (right[:n_knots] - normal[:n_knots, light] @ inner[:, -1]) / noise**2 + information @ unknowns[:n_knots]
        # The knots are the root of their correlation times independent numbers.
        mean, covariance, spread_of_knots = _posterior(root.T @ information @ root, root.T @ pull, spread_of_knots)
        mean, covariance = root @ mean, root @ covariance @ root.T
        change = np.concatenate([mean - unknowns[:n_knots], np.zeros(n_times)])
        change[light] = inner[:, -1] - inner[:, :-1] @ change[:n_knots]
        of_cells = (seen_step - mixed @ change) / of_cell
        unknowns, brightness = unknowns + change, brightness + of_cells
        known_times = n_times - precision * float(np.trace(np.linalg.inv(normal[light, light])))
        light_std = max(float(np.sqrt((unknowns[light] ** 2).sum() / max(known_times, 1e-9))), _STEADIEST)
        left = (step - columns @ change - of_cells[seen.cells]) * np.sqrt(weight)
        # Smoothed squares share photons: their residuals are small, and correlated.
        noise = max(float(np.sqrt(np.mean(left**2))) * SMOOTHING, 1e-9)
    _require_known(information, correlation)
    return mean, covariance


def _require_known(information: FloatArray, correlation: FloatArray) -> None:
    """Raise an `InputError` if photons and motion do not determine enough of the variance of the gain."""
    seen = np.diag(information) > 0
    left = np.linalg.inv(information + np.linalg.inv(correlation * _WIDEST**2))
    # The mean of the gain is that of the scene.
    unknown, before = (np.trace(each) - each.mean() * len(each) for each in (left[seen][:, seen], correlation[seen][:, seen]))
    known = float(1 - unknown / (before * _WIDEST**2)) if seen.any() else 0.0
    if known < _LEAST_KNOWN:
        raise InputError(
            f"corrections: flat-field: photons and motion determine {max(known, 0):.0%} of the variance of the gain, and "
            f"{_LEAST_KNOWN:.0%} are needed; move the camera along x and y, collect more light, or leave flat-field out"
        )


def _posterior(information: FloatArray, pull: FloatArray, std: float) -> tuple[FloatArray, FloatArray, float]:
    """Solve `information @ a = pull` with a Gaussian prior of a, whose standard deviation is found with it (MacKay)."""
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0), vectors.T @ pull
    for _ in range(50):
        known = values * std**2 / (values * std**2 + 1)
        mean = along / (values + std**-2)
        std = float(np.clip(np.sqrt((mean**2).sum() / max(known.sum(), 1e-9)), _NARROWEST, _WIDEST))
    return vectors @ mean, (vectors / (values + std**-2)) @ vectors.T, std
