"""Tremor within groups: short spans of frames against the merged exposures, through depth, in six degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from photonpano import FloatArray, FrameSpan, Source
from photonpano.compiling import compiled
from photonpano.filtering import exceeding_noise
from photonpano_colmap.posing.merging import PosedExposure, lit_counts
from photonpano_colmap.posing.path import Path, between

_NOISE_PX = 0.1
"""Spans are long enough that photon noise moves their shift by no more than this, if the limits below allow it."""
_SHORTEST, _LONGEST = 6, 32
"""Fewest and most frames of a span."""
_FEWEST = 16
"""Fewer spans than this have no spectrum."""
_BLUR_PX = 1.0
"""Standard deviation of the blur of an exposure before its slopes are taken."""
_SLOPE_NOISE = (1 - np.exp(-1 / _BLUR_PX**2)) / (8 * np.pi * _BLUR_PX**2)
"""Variance of a slope that is noise, relative to that of a pixel before the blur."""
_BORDER = 4
"""Pixels nearer to unknown ones have no slope."""
_UNKNOWNS, _GAIN = 7, 6
"""Of a span: rotation and shift of the camera, each along three axes, and last the gain of the light."""
_PRIOR = 1e-4
"""Information that keeps the equations of a span regular: all of a step is below 100 px."""


@dataclass(frozen=True, slots=True, eq=False)
class Tremor:
    """What the camera does faster than its path.

    Attributes:
        steps: (T, 6) small motions (w, v) of the camera at each frame; see `path`.
        std_rotation: (T,) noise of these, in radians.
        std_position: (T,) the same of the position, in units of the world.
        rms_px: root mean square of what the steps move in the image.
    """

    steps: FloatArray
    std_rotation: FloatArray
    std_position: FloatArray
    rms_px: float


def find_tremor(
    source: Source, exposures: Sequence[PosedExposure], path: Path, camera_matrix: FloatArray, pool: ThreadPoolExecutor
) -> Tremor | None:
    """Find how the camera moves within groups that were merged along a path.

    A span of a few frames shows what the exposure of its group shows, moved by a step of the camera: one step of weighted least
    squares. Steps are filtered in the modes that the photons tell apart: some turns and shifts of the camera look alike.

    Args:
        source: the capture.
        exposures: of groups side by side, merged along the path.
        path: of the camera.
        camera_matrix: (3, 3) K.

    Returns:
        None if the capture is too short.
    """
    units = _Units(camera_matrix, float(np.median([np.median(each.inverse_depth) for each in exposures])))
    predicted = list(pool.map(lambda posed: _prediction(posed, units), exposures))
    size = _span_frames(predicted)

    def measured(posed: PosedExposure, prediction: _Prediction) -> list[_Step]:
        spans = _divided(posed.exposure.group.span, size)
        turns, shifts = between(posed.pose, path.at([span.centre for span in spans]), camera_matrix)
        return [_measured(source, *each, posed, prediction, units) for each in zip(spans, turns, shifts, strict=True)]

    found = [step for steps in pool.map(measured, exposures, predicted) for step in steps]
    if len(found) < _FEWEST:
        return None
    steps, covariance = np.array([each.pixels for each in found]), np.array([each.covariance for each in found])
    signal, noise = exceeding_noise_of_modes(steps, covariance)
    instants = np.array([each.instant for each in found])
    frames = np.arange(source.info.n_frames)
    at_frames = CubicSpline(instants, signal)(np.clip(frames, instants[0], instants[-1]))
    stds = [np.interp(frames, instants, np.sqrt(noise[:, part].sum(axis=1))) for part in (slice(3), slice(3, 6))]
    return Tremor(
        at_frames / units.pixels,
        stds[0] / units.pixels[0],
        stds[1] / units.pixels[3],
        float(np.sqrt(np.mean(np.sum(signal**2, axis=1)))),
    )


def exceeding_noise_of_modes(steps: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Filter small motions of a camera in the modes that are measured independently of each other.

    Args:
        steps: (S, 6) px, in order of time.
        covariance: (S, 6, 6) of their noise.

    Returns:
        What exceeds the noise, (S, 6); and the variances that the filter let through, (S, 6).
    """
    _, modes = np.linalg.eigh(np.linalg.inv(covariance).mean(axis=0))
    variances = np.einsum("ka,skl,la->sa", modes, covariance, modes)
    filtered = [exceeding_noise(*columns) for columns in zip((steps @ modes).T, variances.T, strict=True)]
    signal, stds = (np.stack([getattr(each, name) for each in filtered], axis=1) for name in ("signal", "std"))
    return signal @ modes.T, stds**2 @ (modes**2).T


class _Units:
    """What a motion of the camera moves in the image, so that all unknowns are of one size."""

    def __init__(self, camera_matrix: FloatArray, inverse_depth: float) -> None:
        self.to_ideal, self.inverse_depth = np.linalg.inv(camera_matrix), inverse_depth
        self.pixels = camera_matrix[0, 0] * np.array([1.0, 1.0, 1.0, inverse_depth, inverse_depth, inverse_depth])


class _Prediction(NamedTuple):
    """What a frame of a group is expected to show, as its reference instant sees it.

    Attributes:
        mean: (H, W) expected count of a frame.
        slope_x: (H, W) its slope along x, divided by the variance of a frame; 0 where it is not known.
        slope_y: (H, W) the same along y.
        gain: (H, W) the mean, divided by that variance; 0 where the slopes are not known.
        inverse_depth: (H, W).
        information: (7, 7) of one frame that sees all of it.
    """

    mean: NDArray[np.float32]
    slope_x: NDArray[np.float32]
    slope_y: NDArray[np.float32]
    gain: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]
    information: FloatArray


class _Step(NamedTuple):
    """The motion of the camera in a span: (6,) px, and its (6, 6) covariance by photon noise."""

    instant: float
    pixels: FloatArray
    covariance: FloatArray


def _prediction(posed: PosedExposure, units: _Units) -> _Prediction:
    exposure, response = posed.exposure, posed.exposure.response
    known = np.isfinite(exposure.flux) & (exposure.weight > 0)
    flux, frames = np.where(known, exposure.flux, np.float32(0)), np.where(known, exposure.weight, np.float32(1))
    mean = response.mean_count(flux)
    little = np.float32(1e-2) * np.maximum(flux, np.float32(1e-2))
    by_flux = (response.mean_count(flux + little) - mean) / little
    variance = np.maximum((by_flux * response.flux_std(flux, frames)) ** 2 * frames, np.float32(1e-6))
    inner = cv2.erode(known.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8), borderValue=0).astype(bool)
    smooth = cv2.GaussianBlur(mean, (0, 0), _BLUR_PX)
    slope_x, slope_y = (np.where(inner, cv2.filter2D(smooth, cv2.CV_32F, each), np.float32(0)) for each in _DIFFERENCES)
    # Slopes that are noise would count as structure.
    noise = np.where(inner, np.float32(_SLOPE_NOISE) / frames, np.float32(0))
    gain = np.where(inner, mean / variance, np.float32(0))
    information = np.zeros((_UNKNOWNS, _UNKNOWNS))
    predicted = _Prediction(mean, slope_x / variance, slope_y / variance, gain, posed.inverse_depth, information)
    _add_information(predicted, slope_x, slope_y, noise, units.to_ideal, units.inverse_depth)
    information += np.triu(information, 1).T
    return predicted


_DIFFERENCES = [np.array(kernel, np.float32) for kernel in ([[-0.5, 0, 0.5]], [[-0.5], [0], [0.5]])]


def _span_frames(predicted: Sequence[_Prediction]) -> int:
    """Return how many frames show a shift with little noise."""
    mean = np.mean([each.information[3:5, 3:5] for each in predicted], axis=0)
    variance = float(np.trace(np.linalg.pinv(mean))) / 2
    return int(np.clip(np.ceil(variance / _NOISE_PX**2), _SHORTEST, _LONGEST))


def _divided(span: FrameSpan, size: int) -> list[FrameSpan]:
    """Return parts of a span, side by side, of about a size."""
    borders = np.linspace(span.start, span.stop, max(1, round(len(span) / size)) + 1).round().astype(int).tolist()
    return [FrameSpan(*ends) for ends in pairwise(borders)]


def _measured(
    source: Source,
    span: FrameSpan,
    turn: FloatArray,
    shift: FloatArray,
    posed: PosedExposure,
    predicted: _Prediction,
    units: _Units,
) -> _Step:
    """Return the motion of the camera in a span, beyond that along which its group was merged."""
    valid = source.valid.astype(np.float32)
    sums = np.zeros(_UNKNOWNS + 1)
    frames, weight = lit_counts(source, span) * valid, valid * np.float32(len(span))
    _add_residuals(frames, weight, predicted, turn, shift, units.to_ideal, units.inverse_depth, sums)
    gradient, seen = sums[:_UNKNOWNS], sums[_UNKNOWNS]
    # The exposure holds the frames of the span, and follows them by their share.
    share = len(span) / len(posed.exposure.group.span)
    full = predicted.information[_GAIN, _GAIN]
    information = predicted.information * (seen / full if full > 0 else 0.0) + _PRIOR * np.eye(_UNKNOWNS)
    covariance = np.linalg.inv(information)
    step = covariance @ gradient / (1 - share)
    return _Step(span.centre, step[:_GAIN], covariance[:_GAIN, :_GAIN] / (1 - share))


@compiled
def _add_information(
    predicted: _Prediction,
    slope_x: NDArray[np.float32],
    slope_y: NDArray[np.float32],
    noise: NDArray[np.float32],
    to_ideal: FloatArray,
    mean_depth: float,
) -> None:
    """Add the upper triangle of the information of one frame.

    Args:
        predicted: its `information` is added to.
        slope_x: (H, W) slopes of the mean count.
        slope_y: (H, W) the same along y.
        noise: (H, W) variance of a slope that is noise, divided by that of a frame.
        to_ideal: (3, 3) pixels to directions.
        mean_depth: inverse depth of which a shift of the camera counts in px.
    """
    height, width = slope_x.shape
    along_x, along_y = np.zeros(7), np.zeros(7)
    total = predicted.information
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            _moves(row, column, predicted.inverse_depth[row, column] / mean_depth, to_ideal, along_x, along_y)
            x_x = predicted.slope_x[row, column] * slope_x[row, column] - noise[row, column]
            x_y = predicted.slope_x[row, column] * slope_y[row, column]
            y_y = predicted.slope_y[row, column] * slope_y[row, column] - noise[row, column]
            mean = predicted.mean[row, column]
            x_m, y_m = predicted.slope_x[row, column] * mean, predicted.slope_y[row, column] * mean
            for i in range(6):
                u, v = along_x[i] * x_x + along_y[i] * x_y, along_x[i] * x_y + along_y[i] * y_y
                for j in range(i, 6):
                    total[i, j] += u * along_x[j] + v * along_y[j]
                total[i, 6] -= along_x[i] * x_m + along_y[i] * y_m
            total[6, 6] += gain * mean


@compiled
def _add_residuals(
    frames: NDArray[np.float32],
    frame_weight: NDArray[np.float32],
    predicted: _Prediction,
    turn: FloatArray,
    shift: FloatArray,
    to_ideal: FloatArray,
    mean_depth: float,
    sums: FloatArray,
) -> None:
    """Add the right-hand side of the equations of a span, and the light that it sees: (8,).

    Args:
        frames: (H, W) sum of the frames of the span.
        frame_weight: (H, W) number of frames in each pixel of the sum.
        predicted: what one frame is expected to show.
        turn: (3, 3), see `path.between`.
        shift: (3,), see `path.between`.
        to_ideal: (3, 3) pixels to directions.
        mean_depth: inverse depth of which a shift of the camera counts in px.
        sums: (8,) output.
    """
    height, width = frames.shape
    along_x, along_y = np.zeros(7), np.zeros(7)
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            q = predicted.inverse_depth[row, column]
            depth = turn[2, 0] * column + turn[2, 1] * row + turn[2, 2] + q * shift[2]
            if not depth > 0:
                continue
            u = (turn[0, 0] * column + turn[0, 1] * row + turn[0, 2] + q * shift[0]) / depth
            v = (turn[1, 0] * column + turn[1, 1] * row + turn[1, 2] + q * shift[1]) / depth
            if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
                continue
            i, j = min(int(u), width - 2), min(int(v), height - 2)
            a, b = u - i, v - j
            seen = (1 - b) * ((1 - a) * frame_weight[j, i] + a * frame_weight[j, i + 1]) + b * (
                (1 - a) * frame_weight[j + 1, i] + a * frame_weight[j + 1, i + 1]
            )
            lit = (1 - b) * ((1 - a) * frames[j, i] + a * frames[j, i + 1]) + b * (
                (1 - a) * frames[j + 1, i] + a * frames[j + 1, i + 1]
            )
            mean = predicted.mean[row, column]
            residual = lit - seen * mean
            _moves(row, column, q / mean_depth, to_ideal, along_x, along_y)
            by_x, by_y = residual * predicted.slope_x[row, column], residual * predicted.slope_y[row, column]
            # What a camera moves by, its image moves against.
            for k in range(6):
                sums[k] -= by_x * along_x[k] + by_y * along_y[k]
            sums[6] += residual * gain
            sums[7] += seen * gain * mean


@compiled
def _moves(row: int, column: int, q: float, to_ideal: FloatArray, along_x: FloatArray, along_y: FloatArray) -> None:
    """Write where a pixel moves by turns and shifts of the camera along its three axes, in px: (6,) along x and along y."""
    x = to_ideal[0, 0] * column + to_ideal[0, 2]
    y = to_ideal[1, 1] * row + to_ideal[1, 2]
    along_x[0], along_x[1], along_x[2] = -x * y, 1 + x * x, -y
    along_y[0], along_y[1], along_y[2] = -(1 + y * y), x * y, x
    along_x[3], along_x[4], along_x[5] = q, 0.0, -x * q
    along_y[3], along_y[4], along_y[5] = 0.0, q, -y * q
