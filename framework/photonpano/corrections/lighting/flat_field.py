"""Measure the flat field of a capture, the relative gain of its pixels, from a scene that moves through the frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from photonpano.contracts.protocols import Source, Trajectory
from photonpano.corrections.lighting.finding import speed_px
from photonpano.corrections.lighting.gains import SMOOTHING, STRUCTURE, SeenCells, seen_cells
from photonpano.errors import InputError
from photonpano.execution.context import Context
from photonpano.geometry import inverse
from photonpano.values import FloatArray, FluxImage, FrameSpan

_SPANS, _SPAN_PX = 128, 4.0  # most spans of frames that are compared; the image moves by no more than this in each
_KNOTS = 12  # knots of the gain along the shorter side of a frame; between them, its logarithm is bilinear
_LENGTH = 0.5  # distance over which knots are correlated, relative to the shorter side of a frame
_WIDEST = 1.0  # prior standard deviation of the logarithm of the gain
# Rounds of least squares, in which noise and spread of the gain are measured. Outliers keep their weight: counts of few
# photons are skewed, and down-weighting would bias their mean.
_ROUNDS = 4
# Standard deviation of the logarithm of the light before it is measured, and the least. A gain that falls along x and light
# that changes as the image shifts look alike, so that the light changes by no more than the gain leaves over.
_STEADY, _LEAST_CHANGE = 0.03, 1e-3
_LEAST_KNOWN = 0.5  # least share of the prior variance of the gain that photons and motion must remove
_NARROWEST = 1e-3  # least standard deviation of the prior


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
    length = max(1, min(int(_SPAN_PX / max(speed_px(source, trajectory), 1e-9)), n_frames // _SPANS))
    starts = np.linspace(0, n_frames - length, min(_SPANS, n_frames // length)).astype(int).tolist()
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
        side = min(frame_shape) / (_KNOTS - 1)
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
        return np.asarray(np.exp(-distance / (_LENGTH * (_KNOTS - 1))))

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
        light_std = max(float(np.sqrt((unknowns[light] ** 2).sum() / max(known_times, 1e-9))), _LEAST_CHANGE)
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
