"""Compare what successive frames see of the same places: the gain of the light, apart from the brightness of the scene.

Light that flickers at one frequency has an amplitude and a phase of its own at each place of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source, Trajectory, camera_of_motion
from photonpano.execution.context import Context
from photonpano.filtering import gradient_of
from photonpano.geometry import Camera, Canvas, canvas_around, canvas_of, covered_by, depths
from photonpano.merging import Chunk, accumulate
from photonpano.merging.accumulate import weights_of
from photonpano.robust import huber_weights, robust_std
from photonpano.values import FloatArray, FluxImage, FrameSpan, Homography

_CELLS = 24  # squares of the scene along the shorter side of a frame
_LARGEST_PX = 32  # largest side of a square, px
# Standard deviation of the Gaussian that weights the pixels of a square, in sides: sums must not depend on the sub-pixel
# position of a frame.
_BLUR = 0.75
# Of frames before the reference plane, relative to its own frame: squares are at most four times as wide there.
_LEAST_DEPTH = 0.25
# Factor by which the Gaussian lowers the noise of a square; errors of neighbours are correlated instead.
SMOOTHING = 2 * _BLUR * np.sqrt(np.pi)
_COVERED = 0.999  # least covered share of a square: those at the border of a frame are left out
_MOST_CELLS = 16_000  # squares of the whole scene: they are larger if the motion is long
# Relative error of a square beside photon noise: frames sample its structure at different sub-pixel positions.
STRUCTURE = 0.1
_ROUNDS = 4  # of iteratively reweighted least squares
_OUTLIER = 3.0  # standard deviations from which a square is down-weighted (Huber), such as one that an object crosses
_DARKEST = -7.0  # least logarithm of a gain
# Weight of the prior of steady light, relative to that of the photons: it matters where frames share no place.
_WEAK = 1e-6
_TO_SQUARES = np.array([[0.5, 0, -0.5], [0, 0.5, -0.5], [0, 0, 1]])  # pixels of half the side of a square, to squares
_WIDEST = np.pi / 2  # widest field of view, in radians, of which squares lie on a plane


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SeenCells:
    """Photons of squares of the scene in spans of frames: N observations of C squares in S spans."""

    spans: tuple[FrameSpan, ...]
    cells: NDArray[np.intp]  # (N,) index of the square, below `n_cells`
    times: NDArray[np.intp]  # (N,) index of the span
    photons: FloatArray  # (N,) photons, those that a saturated pixel missed included
    exposure: FloatArray  # (N,) pixels times frames
    canvas: Canvas  # whose pixels are the squares: h rows and w columns, C in all

    @property
    def n_cells(self) -> int:
        """C."""
        return self.canvas.height * self.canvas.width

    @property
    def instants(self) -> FloatArray:
        """(S,) centres of the spans."""
        return np.array([span.centre for span in self.spans])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Gains:
    """The light of spans of frames, up to a common factor."""

    seen: SeenCells
    logarithm: FloatArray  # (S,) of the gain, 0 on average
    std: FloatArray  # (S,) its standard deviation
    brightness: FloatArray  # (C,) logarithm of the flux of each square in light of gain 1; NaN for squares that were not seen
    change: float  # root mean square of the change of the light between spans that see the same places, noise subtracted
    shifted: FloatArray  # (N,) logarithm of what errors of the motion change in each observation

    @property
    def gain(self) -> FloatArray:
        """(S,) gain of each span, 1 on average."""
        gain = np.exp(self.logarithm)
        return np.asarray(gain / gain.mean())


def seen_cells(source: Source, trajectory: Trajectory, spans: Sequence[FrameSpan], context: Context) -> SeenCells:
    """Sum the photons of squares of the scene in spans of frames, along a motion known to a few pixels.

    The image must hardly move in a span; spans that a plane can hardly show are left out, and those that show nothing.
    """
    shape = source.info.frame_shape
    spans = capture_of(source).shown(spans)
    motions = trajectory.at([span.centre for span in spans])
    camera = camera_of_motion(trajectory)
    if camera is None:
        # A first motion may be wrong somewhere. Frames far to the side of the plane would need a canvas without end.
        near = depths(motions, shape).min(axis=1) > _LEAST_DEPTH
        spans, motions = [span for span, is_near in zip(spans, near, strict=True) if is_near], motions[near]
    half = int(np.clip(min(shape) // _CELLS, 2, _LARGEST_PX)) // 2
    canvas = scene_canvas(camera, motions, shape, 1 / half)
    while canvas.height * canvas.width > 4 * _MOST_CELLS:
        half *= 2
        canvas = scene_canvas(camera, motions, shape, 1 / half)
    covered = _COVERED * least_weight(source, 2 * half) * float(source.valid.mean())

    seen = partial(_seen, source, canvas, half, covered)
    parts = list(context.in_order(seen, list(zip(spans, motions, strict=True))))
    cells = np.concatenate([part[0] for part in parts])
    times = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    return SeenCells(
        spans=tuple(spans),
        cells=cells,
        times=times,
        photons=np.concatenate([part[1] for part in parts]),
        exposure=np.concatenate([part[2] for part in parts]),
        canvas=replace(canvas, height=canvas.height // 2, width=canvas.width // 2, transform=_TO_SQUARES @ canvas.transform),
    )


def least_weight(source: Source, side: int) -> float:
    """Return the least mean weight of the valid pixels of a square of `side` px: those of faint colours weigh less than 1."""
    weights = weights_of(source)
    if weights is None:
        return 1.0
    weight, valid = (cv2.blur(each, (side, side)) for each in (weights, source.valid.astype(np.float32)))
    inside = valid >= min(0.5, float(valid.max()))
    return float((weight[inside] / valid[inside]).min())


def _seen(
    source: Source, canvas: Canvas, half: int, covered: float, place: tuple[FrameSpan, Homography]
) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return the squares that a span sees, the photons in them, and their exposures in frames and pixels.

    A square has the side of two pixels of the canvas, each of which has the side of `half` pixels of a frame; it is seen in
    the share `covered` of the frames at least. `place` is the span, and where its frames lie.
    """
    span, homography = place
    summed = accumulate(source, [Chunk(span, homography)], canvas, canvas.shape)
    n_rows, n_columns = canvas.height // 2, canvas.width // 2
    counts, weight = (
        cv2.GaussianBlur(image, (0, 0), 2 * _BLUR)[1::2, 1::2][:n_rows, :n_columns]
        for image in (np.maximum(summed.counts, 0), summed.weight)
    )
    light = capture_of(source).light
    index = np.flatnonzero(weight > covered * len(span) * (1.0 if light is None else light.mean(span)))
    frames = np.asarray(weight.ravel()[index], np.float32)
    exposure = 4 * half**2 * frames
    flux = source.response.flux(np.asarray(counts.ravel()[index] / frames, np.float32), exposure)
    return index, np.asarray(np.maximum(flux, 0) * exposure, np.float64), exposure.astype(np.float64)


def scene_canvas(camera: Camera | None, motions: FloatArray, frame_shape: tuple[int, int], scale: float) -> Canvas:
    """Return a canvas that holds all frames, `scale` pixels to one of a frame: a sphere if the camera turns far, or a plane.

    The motions are (N, 3, 3), pixels of a frame to pixels of the reference plane; the camera is None unless it turns.
    """
    if camera is not None:
        covered = covered_by(camera.rotations(motions), camera, frame_shape)
        if covered.field_of_view > _WIDEST:
            return canvas_around(covered, camera, scale, "spherical")
    return canvas_of(motions, frame_shape, scale)


def solve_gains(seen: SeenCells) -> Gains:
    """Solve for the gain of each span and the brightness of each square, from all that saw the same places.

    A square c in a span t sends `exposure exp(s_c + l_t + g_c d_t)` photons, where d_t is the error of the motion, and g_c the
    gradient of s: a tremor makes squares beside an edge flicker. The weight of a square is that of photon noise together with
    what its structure adds. Squares and light are found by iterated least squares, the squares eliminated, and the errors of
    the motion between these steps.
    """
    n_times = len(seen.spans)
    photons, exposure = (np.bincount(seen.cells, each, seen.n_cells) for each in (seen.photons, seen.exposure))
    brightness, light = np.log((photons + 0.5) / np.maximum(exposure, 1)), np.zeros(n_times)
    shifted = np.zeros(len(seen.photons))
    robust = np.ones(len(seen.photons))
    for _ in range(_ROUNDS):
        expected = seen.exposure * np.exp(brightness[seen.cells] + light[seen.times] + shifted)
        step = (seen.photons - expected) / np.maximum(expected, 1e-12)
        weight = robust / (1 / np.maximum(expected, 1e-12) + STRUCTURE**2)
        change, of_cells, covariance, shared = _step(seen, weight, np.clip(step, -2, 2))
        light = np.clip(light + change, _DARKEST, -_DARKEST)
        brightness = brightness + of_cells
        light -= light.mean()
        left = step - change[seen.times] - of_cells[seen.cells]
        shifted += _shifted(seen, brightness, weight, left)
        left *= np.sqrt(weight / np.maximum(robust, 1e-9))
        scale = max(robust_std(left), 1e-9)
        # Smoothed squares share photons: their residuals are small, and correlated.
        noise = scale * SMOOTHING
        robust = huber_weights(left, _OUTLIER * scale)
    difference = light[:, None] - light
    covariance *= noise**2
    expected = np.diag(covariance)[:, None] + np.diag(covariance) - 2 * covariance
    off = shared * (1 - np.eye(n_times))
    squares = float((off * (difference**2 - expected)).sum() / max(off.sum(), 1e-12))
    unseen = np.bincount(seen.cells, minlength=seen.n_cells) == 0
    return Gains(
        seen=seen,
        logarithm=light,
        std=np.sqrt(np.diag(covariance)),
        brightness=np.where(unseen, np.nan, brightness),
        change=float(np.sqrt(max(squares, 0))),
        shifted=shifted,
    )


def _shifted(seen: SeenCells, brightness: FloatArray, weight: FloatArray, left: FloatArray) -> FloatArray:
    """Return the part of residuals that a shift of each span explains: (N,)."""
    unseen = np.bincount(seen.cells, minlength=seen.n_cells) == 0
    image = np.where(unseen, np.nan, brightness).reshape(seen.canvas.shape)
    gradient = np.stack([np.nan_to_num(each).ravel() for each in gradient_of(image)])[:, seen.cells]
    # Least-squares equations of each span: both shifts, beside a change of the light.
    sums = partial(np.bincount, seen.times, minlength=len(seen.spans))
    columns = np.concatenate([gradient, np.ones((1, len(left)))])
    weighted = weight * columns
    normal = np.array([[sums(one * other) for other in columns] for one in weighted])
    right = np.array([sums(one * left) for one in weighted])
    shift = np.linalg.solve(np.moveaxis(normal, -1, 0) + np.eye(3), right.T[..., None])[:, :2, 0]
    return np.asarray((shift[seen.times].T * gradient).sum(axis=0))


def _step(seen: SeenCells, weight: FloatArray, step: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Solve `step = s_c + l_t` for changes of the light (S,) and of the squares (C,).

    Also return the covariance of the light, (S, S), and how much two spans saw of the same squares, (S, S), in weights.
    """
    n_times = len(seen.spans)
    matrix = np.zeros((seen.n_cells, n_times))
    matrix[seen.cells, seen.times] = weight
    of_cell = np.maximum(matrix.sum(axis=1), 1e-12)
    right_cells = np.bincount(seen.cells, weight * step, seen.n_cells)
    right_times = np.bincount(seen.times, weight * step, n_times)
    shared = matrix.T @ (matrix / of_cell[:, None])
    normal = np.diag(matrix.sum(axis=0)) - shared
    normal[np.diag_indices(n_times)] += _WEAK * max(float(weight.sum()) / n_times, 1e-12)
    covariance = np.linalg.inv(normal)
    light = covariance @ (right_times - matrix.T @ (right_cells / of_cell))
    light -= light.mean()
    centred = np.eye(n_times) - 1 / n_times
    return light, (right_cells - matrix @ light) / of_cell, centred @ covariance @ centred, shared


_PERIODS = 1.2  # periods for which a place must be in view
_FINER = 3  # oversampling of frequency: steps per 1/T, where a place is in view for T
_AT_ONCE = 32  # frequencies whose waves are compared with the photons at once: some megabytes each for a long motion
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
_FLICKER_ROUNDS = 3  # of fitting amplitudes and slow changes of the light in turn
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
    parts = np.array_split(frequencies, -(-len(frequencies) // _AT_ONCE))
    found = np.concatenate([_explained(series, weights, instants, each) for each in parts])
    peak = int(np.argmax(found))
    # Of a wave of amplitude a, this is a^2 / 2.
    smallest = max(_STANDS_OUT * float(np.median(found)), _SMALLEST**2)
    if peak in (0, len(found) - 1) or found[peak] < smallest:
        return None
    near = float(frequencies[peak - 1]), float(frequencies[peak + 1])
    best = minimize_scalar(partial(_misfit, gains), bounds=near, options={"xatol": _ACCURACY * near[0]})
    flicker = _measured_flicker(gains, float(best.x))
    alike = replace(flicker, maps=np.zeros_like(flicker.maps), slow=gains.gain)
    # Medians, since things that move change the light of their places, too.
    left, common = (robust_std(_left(gains, each)[0]) ** 2 for each in (flicker, alike))
    noise = float(np.median(_left(gains, flicker)[1]))
    # Of light that is the same everywhere, one gain leaves as little as places do.
    is_local = common - left > max((1 - _BETTER) * (common - noise), (_SMALLEST / 2) ** 2)
    return flicker if is_local else None


def _explained(series: FloatArray, weights: FloatArray, instants: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return the mean square, (F,), that waves of each frequency explain in (C, S) weighted series with means of their own."""
    turns = 2 * np.pi * np.outer(instants, frequencies)
    cosines, sines = np.cos(turns), np.sin(turns)
    light, total = series.sum(axis=1, keepdims=True), np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    cosine, sine = weights @ cosines, weights @ sines
    # Normal equations of cosine and sine, beside the mean: least squares by Cramer's rule.
    of_cosine, of_sine = series @ cosines - light * cosine / total, series @ sines - light * sine / total
    squares, least = weights @ cosines**2, _LEAST_INFORMATION * total + 1e-12
    squares, rest = squares - cosine**2 / total + least, total - squares - sine**2 / total + least
    product = weights @ (cosines * sines) - cosine * sine / total
    gained = rest * of_cosine**2 - 2 * product * of_cosine * of_sine + squares * of_sine**2
    return np.asarray((gained / (squares * rest - product**2)).sum(axis=0) / total.sum())


def _of_neighbours(seen: SeenCells, values: FloatArray) -> FloatArray:
    """Return the values of the observations, each shared among neighbours that flicker alike: (C, S)."""
    found = np.zeros((len(seen.spans), seen.n_cells))
    found[seen.times, seen.cells] = values
    for row in found:
        row[:] = cv2.GaussianBlur(row.reshape(seen.canvas.shape), (0, 0), _ALIKE_CELLS, borderType=cv2.BORDER_CONSTANT).ravel()
    return found.T


def _misfit(gains: Gains, frequency: float) -> float:
    """Return the mean square that a flicker of a frequency leaves in the photons."""
    left, noise = _left(gains, _measured_flicker(gains, frequency))
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


def _measured_flicker(gains: Gains, frequency: float) -> LocalFlicker:
    """Fit the amplitude and the phase of each square of the scene at a frequency; spans must be much shorter than a period."""
    seen, waves = gains.seen, _waves(gains.seen, frequency)
    period = max(1, round(1 / (frequency * float(np.median(np.diff(seen.instants))))))
    amplitudes, slow = np.zeros((2, *seen.canvas.shape)), np.ones(len(seen.spans))
    for _ in range(_FLICKER_ROUNDS):
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
