"""Tremor within groups: short spans of frames against the merged exposures, through depth.

Only rotations are corrected. A tremor of half a millimetre moves things at 4 m by a tenth of what its rotations move them, and
within a group a translation looks almost like a rotation: noise, or an error of depth, would be taken for it. The power of the
translation is estimated from the spectrum of the shifts, above a noise floor that is the same at all frequencies.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from photonpano import FloatArray, FrameSpan, Source, capture_of
from photonpano.compiling import compiled
from photonpano.filtering import exceeding_noise
from photonpano.geometry import Camera
from photonpano.photometry import flux_std
from photonpano_colmap.exposures import Image, Lens, Path, PosedExposure, between, imaged, lens_of, lit_counts

_NOISE_PX = 0.1  # standard error of the shift of a span that determines its length, within the limits below
_SHORTEST, _LONGEST = 6, 32  # frames of a span
_FEWEST = 16  # fewest spans that have a spectrum
_BLUR_PX = 1.0  # standard deviation of the blur of an exposure before its gradient is computed
# variance of the gradient of noise, relative to that of a pixel before the blur
_SLOPE_NOISE = (1 - np.exp(-1 / _BLUR_PX**2)) / (8 * np.pi * _BLUR_PX**2)
_BORDER = 4  # pixels nearer to masked ones have no gradient
# Unknowns of a span: rotation about three axes, translation along them, and the gain of the light.
_ROTATIONS, _MOTION, _GAIN = slice(3), slice(6), 6
# The translations that are well determined; along the third axis the camera translates as much.
_SIDEWAYS, _AXES = slice(3, 5), 3
_LEAST_INFORMATION = 1e-2  # modes with a standard error above 10 px are unknown


@dataclass(frozen=True, slots=True, eq=False)
class Tremor:
    """Motion of the camera at higher frequencies than its path."""

    rotations: FloatArray  # (T, 3) small rotation vectors of the camera at each frame
    std: FloatArray  # (T,) their noise, in radians
    rms_px: float  # root mean square of the displacement in the image
    shift: float  # root mean square of the shifts within groups, which are not corrected, in units of the world


def find_tremor(
    source: Source, exposures: Sequence[PosedExposure], path: Path, camera: Camera, pool: ThreadPoolExecutor
) -> Tremor | None:
    """Find how the camera moves within groups, side by side, that were merged along a path; None if the frames are too few.

    A span of a few frames shows the exposure of its group, moved by a step of the camera. Steps are estimated by weighted least
    squares, and denoised with a Wiener filter. The result does not depend on the number of threads of the pool.
    """
    inverse_depth = float(np.median([np.median(each.inverse_depth) for each in exposures]))
    predicted = list(pool.map(lambda posed: _prediction(posed, camera, inverse_depth), exposures))
    # Frames of a span that shows a shift with little noise.
    of_frame = np.mean([each.information[:2, :2] for each in predicted], axis=0)
    variance = float(np.trace(np.linalg.pinv(of_frame))) / 2
    size = int(np.clip(np.ceil(variance / _NOISE_PX**2), _SHORTEST, _LONGEST))

    def measured(posed: PosedExposure, prediction: _Prediction) -> list[_Equations]:
        group = posed.exposure.group.span
        borders = np.linspace(group.start, group.stop, max(1, round(len(group) / size)) + 1).round().astype(int).tolist()
        spans = [FrameSpan(*ends) for ends in pairwise(borders)]
        maps = between(posed.pose, path.at([span.centre for span in spans]), camera.matrix)
        return [_measured(source, *each, posed, prediction) for each in zip(spans, *maps, strict=True)]

    found = [equations for each in pool.map(measured, exposures, predicted) for equations in each]
    if len(found) < _FEWEST:
        return None
    gradient, information = np.array([each.gradient for each in found]), np.array([each.information for each in found])
    of_rotations, mean = information[:, _ROTATIONS, _ROTATIONS], information[:, _ROTATIONS, _ROTATIONS].mean(axis=0)
    # In these modes, errors are independent of each other.
    _, modes = np.linalg.eigh(mean)
    steps, variances = _solved(gradient[:, _ROTATIONS] @ modes, modes.T @ of_rotations @ modes)
    filtered = [exceeding_noise(*columns) for columns in zip(steps.T, variances.T, strict=True)]
    rotations = np.stack([each.signal for each in filtered], axis=1) @ modes.T
    noise = np.sqrt(sum(each.std**2 for each in filtered))
    instants, frames = np.array([each.instant for each in found]), np.arange(source.info.n_frames)
    at_frames = CubicSpline(instants, rotations)(np.clip(frames, instants[0], instants[-1]))
    # A turn about x or y moves all pixels alike, but for the corners.
    moved_px = np.sqrt(np.mean(np.einsum("si,ij,sj->s", rotations, mean, rotations)) / max(np.trace(mean[:2, :2]) / 2, 1e-12))
    focal_px = camera.focal_px
    shift = _beyond_noise(_solved(gradient, information)[0][:, _SIDEWAYS]) / (focal_px * inverse_depth)
    return Tremor(at_frames / focal_px, np.interp(frames, instants, noise) / focal_px, float(moved_px), shift)


def _beyond_noise(shifts: FloatArray) -> float:
    """Return the root mean square of the shifts along all axes beyond noise that is white, from those along two: (S, 2)."""
    power = np.abs(np.fft.rfft(shifts - shifts.mean(axis=0), axis=0)[1:]) ** 2
    # The median of an exponential distribution is its mean times ln 2.
    excess = float((power.mean(axis=0) - np.median(power, axis=0) / np.log(2)).sum()) / len(shifts)
    return float(np.sqrt(max(0.0, _AXES / shifts.shape[1] * excess)))


class _Prediction(NamedTuple):
    """Expected counts of a frame of a group, seen from its reference instant."""

    mean: Image  # (H, W) expected count of a frame
    slope_x: Image  # (H, W) its slope along x of ideal pixels, divided by the variance of a frame; 0 where it is not known
    slope_y: Image  # (H, W) the same along y
    gain: Image  # (H, W) the mean, divided by that variance; 0 where the slopes are not known
    inverse_depth: Image  # (H, W)
    mean_depth: float  # inverse depth at which a shift of the camera counts in px
    lens: Lens
    information: FloatArray  # (7, 7) of one frame that sees all of it


class _Equations(NamedTuple):
    """Normal equations of the motion of a span, with its gain eliminated, in px of the image."""

    instant: float  # centre of the span, in frames
    gradient: FloatArray  # (6,) right-hand side
    information: FloatArray  # (6, 6)


def _solved(gradient: FloatArray, information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the solutions of (S, N) and (S, N, N) equations, and their variances, infinite if unknown: (S, N) each."""
    known = np.linalg.eigvalsh(information)[:, 0] > _LEAST_INFORMATION
    covariance = np.linalg.inv(np.where(known[:, None, None], information, np.eye(gradient.shape[1])))
    steps = np.einsum("sab,sb->sa", covariance, gradient)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    return np.where(known[:, None], steps, 0.0), np.where(known[:, None], variances, np.inf)


def _prediction(posed: PosedExposure, camera: Camera, mean_depth: float) -> _Prediction:
    exposure, response = posed.exposure, posed.exposure.response
    known = np.isfinite(exposure.flux) & (exposure.weight > 0)
    flux, frames = np.where(known, exposure.flux, np.float32(0)), np.where(known, exposure.weight, np.float32(1))
    mean = response.mean_count(flux)
    little = np.float32(1e-2) * np.maximum(flux, np.float32(1e-2))
    by_flux = (response.mean_count(flux + little) - mean) / little
    variance = np.maximum((by_flux * flux_std(flux, frames, response)) ** 2 * frames, np.float32(1e-6))
    inner = cv2.erode(known.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8), borderValue=0).astype(bool)
    smooth = cv2.GaussianBlur(mean, (0, 0), _BLUR_PX)
    slope_x, slope_y = (np.where(inner, cv2.filter2D(smooth, cv2.CV_32F, each), np.float32(0)) for each in _DIFFERENCES)
    lens = lens_of(camera, flux.shape)
    (x_x, x_y), (y_x, y_y) = np.moveaxis(lens.slopes.astype(np.float32), (2, 3), (0, 1))
    slope_x, slope_y = slope_x * x_x + slope_y * y_x, slope_x * x_y + slope_y * y_y
    # The gradient of noise would count as structure.
    noise = np.where(inner, np.float32(_SLOPE_NOISE) * (x_x * y_y - x_y * y_x) / frames, np.float32(0))
    gain = np.where(inner, mean / variance, np.float32(0))
    information = np.zeros((_GAIN + 1, _GAIN + 1))
    predicted = _Prediction(
        mean, slope_x / variance, slope_y / variance, gain, posed.inverse_depth, mean_depth, lens, information
    )
    _add_information(predicted, slope_x, slope_y, noise)
    information += np.triu(information, 1).T
    return predicted


_DIFFERENCES = [np.array(kernel, np.float32) for kernel in ([[-0.5, 0, 0.5]], [[-0.5], [0], [0.5]])]


def _measured(
    source: Source, span: FrameSpan, turn: FloatArray, shift: FloatArray, posed: PosedExposure, predicted: _Prediction
) -> _Equations:
    """Return the motion of the camera in a span, beyond that along which its group was merged."""
    valid = capture_of(source).masked_in(span).valid.astype(np.float32)
    sums = np.zeros(_GAIN + 2)
    frames, weight = lit_counts(source, span) * valid, valid * np.float32(len(span))
    _add_residuals(frames, weight, predicted, turn, shift, sums)
    gradient, seen, every = sums[:-1], sums[-1], predicted.information
    every = every * (seen / every[_GAIN, _GAIN] if every[_GAIN, _GAIN] > 0 else 0.0)
    mixed, gain = every[_MOTION, _GAIN], max(every[_GAIN, _GAIN], _LEAST_INFORMATION)
    # The exposure holds the frames of the span, and follows them by their share.
    others = 1 - len(span) / len(posed.exposure.group.span)
    information = (every[_MOTION, _MOTION] - np.outer(mixed, mixed) / gain) * others
    return _Equations(span.centre, gradient[_MOTION] - mixed * (gradient[_GAIN] / gain), information)


@compiled
def _add_information(predicted: _Prediction, slope_x: Image, slope_y: Image, noise: Image) -> None:
    """Add the upper triangle of the information of one frame, from the slopes (H, W) of the mean count.

    `noise` is (H, W), the variance of a slope that is noise, divided by that of a frame.
    """
    height, width = slope_x.shape
    along_x, along_y = np.zeros(6), np.zeros(6)
    total = predicted.information
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            q = predicted.inverse_depth[row, column]
            _moves(row, column, q / predicted.mean_depth, predicted.lens, along_x, along_y)
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
    frames: Image, frame_weight: Image, predicted: _Prediction, turn: FloatArray, shift: FloatArray, sums: FloatArray
) -> None:
    """Add the right-hand side of the equations of a span, and the light that it sees, to the (8,) sums; see `path.between`."""
    (height, width), lens = frames.shape, predicted.lens
    along_x, along_y = np.zeros(6), np.zeros(6)
    for row in range(height):
        for column in range(width):
            gain = predicted.gain[row, column]
            if gain == 0:
                continue
            q, x, y = predicted.inverse_depth[row, column], lens.ideal[row, column, 0], lens.ideal[row, column, 1]
            depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + q * shift[2]
            if not depth > 0:
                continue
            u = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + q * shift[0]) / depth
            v = (turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + q * shift[1]) / depth
            u, v = imaged(lens, u, v)
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
            _moves(row, column, q / predicted.mean_depth, predicted.lens, along_x, along_y)
            by_x, by_y = residual * predicted.slope_x[row, column], residual * predicted.slope_y[row, column]
            # The image moves against the camera.
            for k in range(6):
                sums[k] -= by_x * along_x[k] + by_y * along_y[k]
            sums[6] += residual * gain
            sums[7] += seen * gain * mean


@compiled
def _moves(row: int, column: int, q: float, lens: Lens, along_x: FloatArray, along_y: FloatArray) -> None:
    """Write, (6,) each, how rotations about the camera's axes and translations along them move a pixel, in focal lengths."""
    x = (lens.ideal[row, column, 0] - lens.centre[0]) / lens.focal
    y = (lens.ideal[row, column, 1] - lens.centre[1]) / lens.focal
    along_x[0], along_x[1], along_x[2] = -x * y, 1 + x * x, -y
    along_y[0], along_y[1], along_y[2] = -(1 + y * y), x * y, x
    along_x[3], along_x[4], along_x[5] = q, 0.0, -x * q
    along_y[3], along_y[4], along_y[5] = 0.0, q, -y * q
