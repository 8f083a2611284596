"""Merger `local-flow`: find what moves beyond the global motion in a group, and merge along its motion (paper, section 6).

Pixels whose photons contradict the global motion move. A dense field of their motion is estimated from sub-exposures, coarse to
fine over time. Sub-exposures are weighted along the motion, global or of the field, that explains most of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FrameSpan, Group, Source, Trajectory, VirtualExposure
from photonpano.geometry import inverse
from photonpano.merging import PhotonSum, accumulate, chunks_of, clipped
from photonpano_core.configs import LocalFlowConfig
from photonpano_core.mergers import exposure_of, exposure_shape, require_plain, to_exposure, unwarped_sum
from photonpano_core.motion_fields import (
    SCALE,
    Frames,
    Image,
    MotionField,
    Moved,
    Smoothed,
    SubExposures,
    Sums,
    WeightedFrames,
    add_along,
    add_moments,
    blurred,
    fit_each,
    noise_area_px2,
    rescaled,
    sharpened,
)

_DETAIL_PX = 1.2  # blur of sub-exposures before they are compared: the finest detail that is seen, in px of a frame
_WINDOW_PX = 2.0  # standard deviation of the window over which differences are summed up, in px of a frame
_SMALLEST_PX = 16  # fewer connected pixels, of a frame, are a false alarm: less than the window
_WEAKER = 0.6  # hysteresis: fraction of the threshold above which pixels connected with a moving one move, too
# Radius of the disc by which gaps are closed, in px of a frame: where texture is missing, nothing shows that it moves.
_GAP_PX = 6
_FEWEST = 0.5  # fewest degrees of freedom, on average over the window, of a pixel that is tested
# The same two for differences from the reference, by which sub-exposures are weighted.
_WEIGHTED_DETAIL_PX, _WEIGHTED_WINDOW_PX = 0.9, 1.2
_TOLERATED = 1.5  # squared difference, in units of the photon noise, that costs no weight
_EXPLAINED = 0.8  # fraction of the frames that must agree, or other motions are tried
_MOVES_PX = 1.0  # minimum motion within a group that is propagated to neighbours, in px of a frame
# Numbers of sub-exposures that are tried for a group, with the photons per pixel that each must have.
_NUMBERS = {33: 8.0, 17: 8.0, 9: 2.0, 5: 2.0, 3: 2.0}
_USUAL = 17  # sub-exposures, at most, unless something moves fast
_COMPARED = 9  # sub-exposures, at most, whose differences show what moves: fewer have more light each
_SAMPLED = 16  # frames that are sampled for the mean flux of a group
_AROUND_PX = 6  # dilation of the moving pixels that are merged along the field, in px of a frame
_SWEPT_PX = 6.0  # motion within a sub-exposure, in px of a frame, above which a group is divided into more of them
_MARGIN_PX = 32  # margin around these in which flow is estimated, in px of a frame


@dataclass(frozen=True, slots=True, eq=False)
class GhostMap:
    """Where photons of a group contradict the global motion, on the grid of the exposure at the reference instant."""

    # (H, W), at least 0: by how many standard deviations of photon noise the sub-exposures differ from each other; 0 where
    # fewer than two saw a pixel
    significance: Image
    # (H, W), where it exceeds the threshold, over an area of some pixels, with connected pixels of slightly less significance,
    # and gaps between these
    moving: BoolArray


def compared(parts: SubExposures, n: int, threshold: float, tolerated_px: float) -> GhostMap:
    """Compare sub-exposures that are merged along the global motion, joined to `n` longer ones for more light.

    Of K sub-exposures of a still scene, the squared differences from their mean, in units of the photon noise, add up to
    chi-squared with K - 1 degrees of freedom, here averaged over a window. The cube root of the average is nearly normal
    (Wilson and Hilferty 1931), from which the significance follows. A pixel moves from the `threshold` of significance on; an
    error of the global motion by `tolerated_px` of a frame is not significant.
    """
    response = parts.response
    images = [parts.smoothed(each, _DETAIL_PX) for each in parts.joined(parts.sums, n).sums]
    seen = np.maximum(sum(each.frames for each in images), np.float32(1))
    mean = np.asarray(sum(each.frames * each.values for each in images) / seen, np.float32)
    tolerated = (np.float32(tolerated_px * SCALE) * np.hypot(*np.gradient(mean))) ** 2
    energy, freedom = np.zeros_like(mean), np.full_like(mean, -1)
    for each in images:
        variance = response.stabilised_std(np.maximum(each.frames, 1)) ** 2
        energy += np.where(each.frames > 0, ((each.values - mean) ** 2 - tolerated) / variance, np.float32(0))
        freedom += each.frames > 0
    freedom = np.maximum(blurred(np.maximum(freedom, 0), _WINDOW_PX * SCALE), np.float32(1e-6))
    ratio = np.maximum(blurred(energy, _WINDOW_PX * SCALE) / freedom, 0)
    # Squares of neighbouring pixels are correlated, since their blurs overlap.
    detail = noise_area_px2(_DETAIL_PX, SCALE, parts.spread) / (4 * math.pi)
    correlated = detail / (2 * _WINDOW_PX**2 + detail)
    spread = np.float32(2 / 9 * correlated) / freedom
    significance = np.maximum((np.cbrt(ratio) - (1 - spread)) / np.sqrt(spread), 0)
    significance = np.where(freedom > _FEWEST, significance, np.float32(0)).astype(np.float32)
    return GhostMap(significance, _moving(significance, threshold))


def _moving(significance: Image, threshold: float) -> BoolArray:
    """Return the pixels that move: see `GhostMap`."""
    likely = (significance > _WEAKER * threshold).astype(np.uint8)
    _, labels, _, _ = cv2.connectedComponentsWithStats(likely, connectivity=8)
    above = (significance > threshold).astype(np.uint8)
    _, certain_labels, statistics, _ = cv2.connectedComponentsWithStats(above, connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= _SMALLEST_PX * SCALE**2
    large[0] = False  # the label of what is not above
    certain = large[certain_labels]
    found = np.isin(labels, np.unique(labels[certain])) & (likely > 0)
    gap = round(_GAP_PX * SCALE)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * gap + 1, 2 * gap + 1))
    # Gaps at the border of the image are closed as well.
    padded = cv2.copyMakeBorder(found.astype(np.uint8), gap, gap, gap, gap, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)[gap:-gap, gap:-gap] > 0)


@dataclass(frozen=True, slots=True, eq=False)
class Weighted:
    """Motion of each pixel, and weights of the sub-exposures along it."""

    field: MotionField
    trusts: Image  # (K, H, W), weights from 0 to 1
    explained: Image  # (H, W), share of the frames of a pixel that remain

    def improved(self, other: Weighted, where: BoolArray) -> Weighted:
        """Return, within `where`, the motion and weights of the one that explains more frames of a pixel."""
        better = where & (other.explained > self.explained)
        return Weighted(
            MotionField(np.where(better[..., None], other.field.coefficients, self.field.coefficients)),
            np.where(better, other.trusts, self.trusts),
            np.where(better, other.explained, self.explained),
        )


def weighted(parts: SubExposures, field: MotionField, where: BoolArray) -> Weighted:
    """Find, for each of some pixels (H, W), the motion beyond the global one that explains most of its frames.

    A field is smooth, but the motion jumps at the border of an object. Where the field explains too few frames, a pixel may
    move as its nearest neighbour that moves and is explained, or not at all beyond the global motion.
    """
    sums = parts.along(field, where)
    best = _weighted(parts, field, sums)
    poor = where & (best.explained < _EXPLAINED)
    if not poor.any():
        return best
    movers = where & ~poor & (field.way_px > _MOVES_PX * SCALE)
    if movers.any():
        nearest = field.filled(movers)
        best = best.improved(_weighted(parts, nearest, parts.along(nearest, poor, sums)), poor)
    still = MotionField(np.zeros_like(field.coefficients))
    return best.improved(_weighted(parts, still, parts.sums), poor)


def _weighted(parts: SubExposures, field: MotionField, sums: Sequence[PhotonSum]) -> Weighted:
    """Weight sub-exposures where they differ from the reference by more than photon noise.

    D^2 is the squared difference in units of its variance, averaged over a window. If it exceeds the tolerance by e, the weight
    is `1 / (1 + e)`, the gain of a Wiener filter; it is 1 where either is unseen.
    """
    fixed = parts.smoothed(sums[parts.reference], _WEIGHTED_DETAIL_PX)
    trusts = np.ones((len(sums), *parts.shape), np.float32)
    weight, frames = sums[parts.reference].weight.copy(), sums[parts.reference].weight.copy()
    for place, each in enumerate(sums):
        if place == parts.reference:
            continue
        image = parts.smoothed(each, _WEIGHTED_DETAIL_PX)
        error = blurred(image.squared_difference(fixed, parts.response), _WEIGHTED_WINDOW_PX * SCALE)
        trusts[place] = 1 / (1 + np.maximum(error - np.float32(_TOLERATED), 0))
        weight += trusts[place] * each.weight
        frames += each.weight
    return Weighted(field, trusts, np.asarray(weight / np.maximum(frames, np.float32(1e-3)), np.float32))


# Sub-exposures of each round. Parallax of a camera in the hand changes its speed too often for fewer in the last.
_ROUNDS = 3, 9, 17
_DEGREE = 8  # highest degree of the motion in time
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


class LocalFlowMerger:
    """Warps the counts of a group along the global motion, and where they contradict it, along a dense field beyond it.

    A group is divided into sub-exposures of half the size. Where these agree, all frames are merged as `photon-mle` does, to
    the same flux. Elsewhere optical flow is estimated in rounds. Sub-exposures that still differ from the one around the
    reference instant, such as those in which a pixel is occluded, get less weight. Then counts are warped along the sum of both
    motions, in one interpolation at full size, and its blur is undone where noise allows it.

    In a group with too few photons, and while no motion is known, frames are merged as `photon-mle` does.
    """

    def __init__(self, config: LocalFlowConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`. Raises an `InputError` if the lens distorts, or the light changes."""
        if trajectory is None:
            return exposure_of(unwarped_sum(source, group, scale), source, group, scale)
        photons = self._merged(source, group, trajectory, max(scale, 1.0))
        return exposure_of(rescaled(photons, scale) if scale < 1 else photons, source, group, scale)

    def ghost_map(self, source: Source, group: Group, trajectory: Trajectory) -> GhostMap:
        """Find the pixels of a group whose photons contradict the global motion, on the grid of a frame."""
        found = self._ghosts(self._divided(source, group, trajectory))
        shape = source.info.frame_shape
        return GhostMap(enlarged(found.significance, shape), enlarged(found.moving, shape))

    def _divided(self, source: Source, group: Group, trajectory: Trajectory) -> SubExposures:
        require_plain(source, "local-flow")
        wanted = self._config.sub_exposures
        number = min(number_of(source, group), _USUAL) if wanted == "auto" else wanted
        return SubExposures(source, group, trajectory, number)

    def _ghosts(self, parts: SubExposures) -> GhostMap:
        config = self._config
        return compared(parts, min(_COMPARED, len(parts.spans)), config.significance, config.tolerated_px)

    def _merged(self, source: Source, group: Group, trajectory: Trajectory, scale: float) -> PhotonSum:
        parts, tolerance_px = self._divided(source, group, trajectory), self._config.tolerance_px
        chunks = chunks_of(group.span, trajectory, source.info.frame_shape, tolerance_px)
        onto = to_exposure(group, trajectory, scale)
        total = accumulate(source, chunks, onto, exposure_shape(source, scale))
        moving = self._ghosts(parts).moving
        if not moving.any():
            return total
        side = 2 * round(_AROUND_PX * SCALE) + 1
        where = cv2.dilate(moving.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))).astype(bool)
        box = box_around(where, round(_MARGIN_PX * SCALE))
        there = where[box]
        field = estimate_field(parts.cropped(box), there)
        if self._config.sub_exposures == "auto" and 2 * parts.fastest_px(field, there) > _SWEPT_PX * len(parts.spans):
            parts = parts.divided(number_of(source, group))
        parts = parts.cropped(box)
        best = weighted(parts, field, there)
        fastest_px = parts.fastest_px(best.field, there)
        inside = enlarged(where, total.counts.shape, scale)
        counts, weight = (np.where(inside, np.float32(0), each) for each in (total.counts, total.weight))
        sums = Sums(counts, weight, np.zeros_like(weight))
        frames, cells = WeightedFrames(source, group), (SCALE / scale, box[0].start, box[1].start)
        for span, trust in zip(parts.spans, best.trusts, strict=True):
            for chunk, motion in parts.moving(clipped(chunks, span, trajectory), best.field, fastest_px, tolerance_px):
                to_image = inverse(onto @ chunk.homography)
                summed = Frames(frames(chunk.span), frames.weights, float(len(chunk.span)))
                add_along(summed, to_image, Moved(inside, cells, motion, trust), sums)
        photons = PhotonSum(sums.counts, sums.weight)
        if scale > 1:
            return photons  # Its neighbouring pixels share more noise than `sharpened` expects.
        blur_px2 = np.asarray(sums.blur / np.maximum(sums.weight, np.float32(1e-3)), np.float32)
        return sharpened(photons, blur_px2, inside, source.response)


def enlarged(image: NDArray[Any], shape: tuple[int, int], scale: float = 1.0) -> NDArray[Any]:
    """Return an image of the grid of `SubExposures`, (h, w), on a grid of another scale, (H, W), without interpolation."""
    rows, columns = (
        np.minimum(((np.arange(length) + 0.5) * (SCALE / scale)).astype(int), size - 1)
        for length, size in zip(shape, image.shape, strict=True)
    )
    return image[np.ix_(rows, columns)]


def box_around(where: BoolArray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of a box around some pixels, with a margin."""
    bounds = []
    for axis, length in enumerate(where.shape):
        places = np.flatnonzero(where.any(axis=1 - axis))
        bounds.append(slice(max(int(places[0]) - margin, 0), min(int(places[-1]) + 1 + margin, length)))
    return bounds[0], bounds[1]


def number_of(source: Source, group: Group) -> int:
    """Return how many sub-exposures a group has light for: from 33 to 3; 1 if it is too dark for any."""
    first = max(group.span.start, min(round(group.reference) - _SAMPLED // 2, group.span.stop - _SAMPLED))
    sample = FrameSpan(first, min(first + _SAMPLED, group.span.stop))
    counts = source.counts(sample)[source.valid]
    mean = np.atleast_1d(np.float32(counts.mean() / len(sample) if counts.size else 0))
    photons = float(source.response.flux(mean, len(sample) * max(counts.size, 1))[0]) * len(group.span)
    wanted = (number for number, each in _NUMBERS.items() if photons >= each * number and len(group.span) >= number)
    return next(wanted, 1)
