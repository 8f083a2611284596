"""Estimate a dense field of motion from sub-exposures, coarse to fine over time (paper, section 6, "Dense Motion Models")."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray
from photonpano.merging import PhotonSum
from photonpano_core.mergers.dense_motion.field import Image, MotionField, add_moments, fit_each
from photonpano_core.mergers.dense_motion.frames import blurred
from photonpano_core.mergers.dense_motion.sub_exposures import SCALE, Smoothed, SubExposures

# Sub-exposures of each round. Parallax of a camera in the hand changes its speed too often for fewer in the last.
_ROUNDS = 3, 9, 17
_DEGREE = 8  # highest degree of the motion in time
_DETAIL_PX = 1.2  # blur of sub-exposures before they are compared, in px of a frame
_AGREEMENT_PX = 2.0  # window over which displaced sub-exposures are compared, in px of a frame
_SMOOTHING_PX = 5.0  # window over which the motion is fitted, in px of a frame
_FINEST = {17: 0}  # level of the pyramid at which optical flow of a round ends: 0 is the grid itself; 1, half of it, by default
# Distance of the patches of optical flow, and steps of each: as exact as more of them, and faster.
_PATCH_STEP_PX, _DESCENT_STEPS = 4, 12
_PRIOR = 1e-4  # weight of no motion, relative to that of a sub-exposure at an end of the group
_CLIPPED = 0.2, 99.8  # percentiles of the values that are black and white to the optical flow


def estimate_field(parts: SubExposures, moving: BoolArray) -> MotionField:
    """Estimate how some pixels, (H, W), of merged sub-exposures move beyond the global motion; the field is 0 elsewhere.

    In each round, sub-exposures are merged along the field so far, and joined to 3, then 9, then 17 longer ones. The flow from
    the reference to each of these is added to the field, which is fitted by polynomials of time. So each round has less motion
    that is still unknown, and less of it within a sub-exposure.
    """
    field, sums = MotionField.zero(parts.shape), parts.sums
    for n in _ROUNDS:
        if n > len(parts.spans):
            break
        if n > _ROUNDS[0]:
            sums = parts.along(field, moving)
        field = _refined(parts, sums, field, n, moving)
    return field


def _refined(parts: SubExposures, sums: Sequence[PhotonSum], field: MotionField, n: int, moving: BoolArray) -> MotionField:
    """Return the field after a round of `n` sub-exposures, whose `sums` are merged along the field so far."""
    joined = parts.joined(sums, n)
    images = [parts.smoothed(each, _DETAIL_PX) for each in joined.sums]
    # Stretched to grey levels, all alike: their noise is uniform.
    low, high = np.percentile(np.concatenate([each.values.ravel() for each in images]), _CLIPPED)
    grey = (np.clip((each.values - low) * (255 / max(high - low, 1e-6)), 0, 255) for each in images)
    shades = [each.astype(np.uint8) for each in grey]
    fixed = joined.reference
    times, flows, trusts = [], [], []
    for place, elapsed in enumerate(joined.times):
        if place != fixed:
            flow = _dense_flow(shades[fixed], shades[place], _FINEST.get(n, 1))
            times.append(elapsed)
            flows.append(flow + _displaced(field.at(elapsed), flow))
            trusts.append(_agreement(images[fixed], images[place], flow, parts))
    return MotionField(_fitted(times, flows, trusts, min(_DEGREE, n // 2), moving))


def _dense_flow(fixed: NDArray[np.uint8], moving: NDArray[np.uint8], finest: int) -> Image:
    """Return where pixels of `fixed` lie in `moving`, as a displacement: (H, W, 2), x and y."""
    # Filled, since a flow that is given is where the search starts.
    start = np.zeros((*fixed.shape, 2), np.float32)
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(finest)
    search.setPatchStride(_PATCH_STEP_PX)
    search.setGradientDescentIterations(_DESCENT_STEPS)
    search.setVariationalRefinementIterations(0)
    return np.asarray(search.calc(fixed, moving, start), np.float32)


def _displaced(image: Image, flow: Image) -> Image:
    """Return an image, (H, W) or (H, W, 2), at displaced pixels."""
    rows, columns = np.indices(image.shape[:2], np.float32)
    displaced = cv2.remap(image, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(displaced, np.float32)


def _agreement(fixed: Smoothed, moving: Smoothed, flow: Image, parts: SubExposures) -> Image:
    """Return how well a displaced sub-exposure agrees with the reference: (H, W), 1 up to photon noise, 0 where unseen."""
    there = Smoothed(_displaced(moving.values, flow), _displaced(moving.frames, flow))
    error = blurred(there.squared_difference(fixed, parts.response), _AGREEMENT_PX * SCALE)
    seen = (there.frames > 0) & (fixed.frames > 0)
    return np.where(seen, 1 / np.maximum(error, 1) ** 2, 0).astype(np.float32)


def _fitted(times: list[float], flows: list[Image], trusts: list[Image], degree: int, moving: BoolArray) -> Image:
    """Fit polynomials of time by weighted least squares, over windows, to some pixels: (degree, H, W, 2)."""
    moments = np.zeros((2 * degree - 1, *moving.shape), np.float32)
    right = np.zeros((degree, *moving.shape, 2), np.float32)
    for time, flow, trust in zip(times, flows, trusts, strict=True):
        add_moments(np.float32(time), flow, trust, moments, right)
    for each in (*moments, *right):
        each[...] = blurred(each, _SMOOTHING_PX * SCALE)
    coefficients = np.zeros_like(right)
    fit_each(moments, right, _PRIOR, moving, coefficients)
    return coefficients
