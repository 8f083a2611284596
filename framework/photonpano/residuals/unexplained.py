"""Errors of the motion that the residuals show beyond photon noise, or exclude, frame by frame."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from photonpano.filtering import SYSTEMATIC_PX
from photonpano.geometry import corners
from photonpano.residuals.measure import Residuals
from photonpano.values import BoolArray, FloatArray

_SMOOTH_SPANS = 25  # the ratio is that of motion faster than this many spans
_LOCAL_SPANS = 33  # the size is averaged over this many spans
# Motion is taken to be left where the mean square exceeds that of the noise by this many of its standard deviations.
_SIGNIFICANT = 3.0
_MISFIT = 3.0  # a span also stands out if the mean squared residual / variance of its blocks exceeds this
# A single span stands out if the sum of its four squared steps, over their variances, exceeds this. Noise does so once in
# 200,000 spans.
_STANDS_OUT = 30.0
# The measured steps of three spans bound the error of frames that are at most one span away from one.
_BOUND_SPANS, _NEAR_SPANS = 3, 1.0

_DARK = -0.5  # spans that are darker than predicted by half of the light or more show too little to be measured


def residual_ratio(residuals: Residuals) -> float:
    """Return the scatter of the shifts of short spans over that of photon noise and interpolation; NaN for fewer than 50.

    It is 1 where the motion is all there is. Slow changes are left out, since the panorama follows them.
    """
    steps, variances = _series(residuals)
    shifts, expected = steps[:, :2], variances[:, :2]
    known = np.isfinite(expected).all(axis=1)
    if known.sum() < 2 * _SMOOTH_SPANS:
        return float("nan")
    ratios = shifts[known] / np.sqrt(expected[known])
    kernel = np.ones(_SMOOTH_SPANS) / _SMOOTH_SPANS
    slow = np.stack([np.convolve(np.pad(each, _SMOOTH_SPANS // 2, mode="edge"), kernel, "valid") for each in ratios.T], axis=1)
    return float(np.sqrt(np.mean((ratios - slow) ** 2) / (1 - 1 / _SMOOTH_SPANS)))


def unexplained_px(residuals: Residuals, n_frames: int) -> FloatArray:
    """Return the corner error that the residuals show beyond photon noise, for every frame of the capture: (n_frames,).

    It is the root mean square over 33 spans around the frame, or the step of a single span if that stands out, as at a place
    where frames are missing; 0 where noise explains it.
    """
    steps, variances = _series(residuals)
    known = np.isfinite(variances).all(axis=1)
    if known.sum() < 2:
        return np.zeros(n_frames)
    squares, noise = (steps[known] ** 2).sum(axis=1), variances[known].sum(axis=1)
    spread = 2 * (variances[known] ** 2).sum(axis=1)
    size = min(_LOCAL_SPANS, len(squares))
    kernel = np.ones(size) / size
    left, right = (size - 1) // 2, size // 2
    local, floor, width = (
        np.convolve(np.pad(each, (left, right), mode="reflect"), kernel, "valid") for each in (squares, noise, spread)
    )
    excess = local - floor
    found = np.where(excess > _SIGNIFICANT * np.sqrt(width / size), np.sqrt(np.maximum(excess, 0)), 0)
    # The frames of a span and of its neighbours may move by as much as its step.
    single = np.where((steps[known] ** 2 / variances[known]).sum(axis=1) > _STANDS_OUT, np.sqrt(squares), 0)
    found = np.maximum(found, sliding_window_view(np.pad(single, 1), 3).max(axis=1))
    return np.asarray(np.interp(np.arange(n_frames), residuals.instants[known], found))


def bounded_std_px(std_px: FloatArray, residuals: Residuals) -> FloatArray:
    """Return the expected corner errors (T,), infinite where not located, no larger than the residuals allow.

    A frame lies within its measured shift, roll and zoom of the panorama, and so of the surest frame that sees the same place.
    At the ends of a capture, where motion is extrapolated, this is less than what extrapolation lets expect.
    """
    steps, variances = _series(residuals)
    known = np.isfinite(variances).all(axis=1) & (residuals.gains()[0] > _DARK)
    if known.sum() < _BOUND_SPANS:
        return std_px
    squares = np.pad((steps[known] ** 2 + variances[known]).sum(axis=1), _BOUND_SPANS // 2, mode="edge")
    local = sliding_window_view(squares, _BOUND_SPANS).mean(axis=1)
    frames, instants = np.arange(len(std_px)), residuals.instants[known]
    measured = np.interp(frames, instants, local)
    measured[distance_to_nearest(instants, frames) > _NEAR_SPANS * np.median(np.diff(residuals.instants))] = np.inf
    reach = max(1, int(residuals.frames_seen / 4))
    surest = minimum_filter1d(std_px**2 + measured, 2 * reach + 1, mode="nearest")
    return np.asarray(np.minimum(std_px, np.where(np.isfinite(std_px), np.sqrt(surest + measured), np.inf)))


def distance_to_nearest(instants: FloatArray, frames: NDArray[np.integer]) -> FloatArray:
    """Return the distance of each frame to the nearest of instants that are in order, in frames."""
    after = np.searchsorted(instants, frames).clip(1, len(instants) - 1)
    return np.asarray(np.minimum(abs(frames - instants[after - 1]), abs(frames - instants[after])))


def standing_out(residuals: Residuals) -> BoolArray:
    """Return which spans show a step, or a misfit, that noise does not explain: (S,)."""
    steps, variances = _series(residuals)
    with np.errstate(invalid="ignore"):
        excess = np.nansum(np.where(np.isfinite(variances), steps**2 / variances, 0), axis=1)
    return np.asarray((excess > _STANDS_OUT) | (residuals.misfit > _MISFIT))


def _series(residuals: Residuals) -> tuple[FloatArray, FloatArray]:
    """Return the steps of the spans as motions of a corner in px, and their expected variances: (S, 4) each."""
    shape = corners(residuals.frame_shape)
    radius_px = float(np.linalg.norm(shape[0] - shape.mean(axis=0)))
    to_px = np.array([1, 1, radius_px, radius_px])
    found = residuals.steps()
    information = np.maximum(np.diagonal(found.information, axis1=1, axis2=2), 0)
    with np.errstate(divide="ignore"):
        variances = to_px**2 / information + SYSTEMATIC_PX**2
    return found.steps * to_px, variances
