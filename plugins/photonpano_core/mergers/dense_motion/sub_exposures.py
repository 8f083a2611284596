"""Sub-exposures of a group: short parts of it, merged along the global motion or along a field beyond it, at half the size.

The frames of a part are corrected, weighted and summed, and their sums rescaled, blurred, or sharpened where the noise of their
counts allows it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from photonpano import BoolArray, FloatArray, FrameSpan, Group, Response, Source, Trajectory, capture_of
from photonpano.geometry import inverse, rescaling, transform_points, translation
from photonpano.merging import Chunk, PhotonSum, chunks_of, clipped, divided
from photonpano_core.mergers.dense_motion.fields import Frames, Image, MotionField, Moved, Sums, add_along, mean_of_seen
from photonpano_core.mergers.photon_mle import equal_spans, parts_of, to_exposure

_MANY = 1e4  # frames for which the variance of a count is derived; it is then divided by them
_SHARE = np.float32(0.01)  # relative step of the numerical derivative
_WINDOW_PX = 1.5  # standard deviation of the window over which the Laplacian is compared with its noise, in px


class WeightedFrames:
    """Returns sums of frames of a group: (H, W) float32, corrected, and multiplied by the weight of each pixel.

    Pixels that are masked in some frames of the group are masked in all. What moves by itself is not.
    """

    def __init__(self, source: Source, group: Group) -> None:
        self._capture = capture = replace(capture_of(source), background=None).masked_in(group.span)
        # (H, W) weight of a frame of each pixel, from 0, for a masked one, to 1; (0, 0) if it is 1 for all.
        self.weights: Image
        if capture.weight is not None:
            self.weights = np.where(capture.valid, capture.weight, np.float32(0))
        else:
            self.weights = np.zeros((0, 0), np.float32) if capture.valid.all() else capture.valid.astype(np.float32)

    def __call__(self, span: FrameSpan) -> Image:
        """Sum the frames of a span."""
        lit = np.asarray(self._capture.corrected_counts(span), np.float32)
        return lit * self.weights if self.weights.size else lit


def blurred(image: Image, blur_px: float) -> Image:
    """Blur with a Gaussian; the image is 0 outside of its border."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_CONSTANT), np.float32)


def rescaled(photons: PhotonSum, scale: float) -> PhotonSum:
    """Return a sum on the grid of another scale: p goes to `(p + 0.5) * scale - 0.5`. Flux stays the same."""
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    counts, weight = (
        np.asarray(cv2.resize(each, None, fx=scale, fy=scale, interpolation=how), np.float32)
        for each in (photons.counts, photons.weight)
    )
    return PhotonSum(counts, weight)


def count_variance(mean: Image, response: Response) -> Image:
    """Return the variance of the count of one frame of this mean, from the slope of the scale on which it is uniform."""
    low, high = mean * (1 - _SHARE), mean * (1 + _SHARE) + np.float32(1e-4)
    low_value, high_value = (response.stabilised(response.flux(each, _MANY), _MANY) for each in (low, high))
    per_unit = (high - low) / np.maximum(high_value - low_value, np.float32(1e-9))
    return np.asarray(_MANY * (response.stabilised_std(_MANY) * per_unit) ** 2, np.float32)


def sharpened(photons: PhotonSum, blur: Image, where: BoolArray, response: Response) -> PhotonSum:
    """Sharpen the mean count m of some pixels, (H, W), to `m - g s/2 laplacian(m)`, unless a neighbour is unseen.

    Linear interpolation at a fraction f of a pixel blurs by the variance `f (1 - f)`, on average s (`blur`, in px^2), which
    this undoes to the second order. The Wiener gain g is that of the least squared error. Along an axis, interpolation leaves
    `r0 = 1 - 2 s` of the variance v of photon noise, and a covariance of `r1 = s` between neighbours. So the noise of the
    Laplacian has the variance `N v`, and a covariance of `-C v` with that of the pixel. With the mean square E of the
    Laplacian, over a window, `g = 1 - (N + 2 C / s) v / E`, and 0 where this is negative.
    """
    counts, weight = photons.counts, photons.weight
    seen = cv2.erode((weight > 0).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    frames = np.maximum(weight, np.float32(1e-3))
    mean = np.asarray(counts / frames, np.float32)
    laplacian = np.where(seen, cv2.Laplacian(mean, -1, ksize=1), np.float32(0))
    own, neighbours = 1 - 2 * blur, blur
    noise = 20 * own**2 - 32 * own * neighbours + 8 * neighbours**2
    shared = 4 * own * (own - neighbours)
    share = count_variance(mean, response) / frames / np.maximum(blurred(laplacian**2, _WINDOW_PX), np.float32(1e-12))
    amount = np.maximum(blur - (blur * noise + 2 * shared) * share, 0) / 2
    sharp = np.maximum(mean - amount * laplacian, 0) * weight
    return PhotonSum(np.where(where & seen, sharp, counts).astype(np.float32), weight)


SCALE = 0.5  # pixels of the grid per pixel of a frame
_TOLERANCE_PX = 1.5  # motion within which frames are summed before they are warped, in px of a frame
_PLACES = 5  # about how many samples along an axis give the mean blur of interpolation
_CACHE_BYTES = 64 * 1024**2  # memory for halved sums of frames, which are warped again in each round
# Largest shift of the centroid of a smoothed pixel by uneven weights, in px of a frame; less at a smaller scale.
_SHIFT_PX = 0.2
_MOST = 95.0  # percentile of the speeds of a field that limits how many frames are summed before they are warped
_SAMPLED = 3  # step, along each axis, of the pixels whose speeds are compared
_REACH = 4  # standard deviations at which a Gaussian ends
_SEEN = 0.1  # a pixel is seen by a sub-exposure if this share of its frames, smoothed, shows it


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A sub-exposure on the scale on which photon noise is uniform."""

    values: Image  # (H, W), stabilised flux of the smoothed counts; 0 where unseen
    frames: Image  # (H, W), number of frames of one pixel whose noise equals that of the smoothed value; 0 where unseen

    def squared_difference(self, other: Smoothed, response: Response) -> Image:
        """Return (H, W): the squared difference, in units of its photon noise; 0 where one of both is unseen."""
        seen = (self.frames > 0) & (other.frames > 0)
        mine, others = (response.stabilised_std(np.maximum(each.frames, 1)) ** 2 for each in (self, other))
        difference = (self.values - other.values) ** 2 / (mine + others)
        return np.where(seen, difference, np.float32(0)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Sub-exposures that are joined to longer ones."""

    sums: list[PhotonSum]  # counts and weights of each
    times: list[float]  # the middle of each: see `SubExposures.elapsed`
    reference: int  # index of the one that contains the reference instant


class SubExposures:
    """The sub-exposures of one group, on a grid of half the size of a frame, whose pixels have four times the light.

    Attributes:
        spans: the frames of each, in order.
        shape: (height, width) of the grid.
        sums: counts and weights of each along the global motion.
        reference: index of the one that contains the reference instant.
        spread: mean of f (1 - f) over the fractions f of a pixel at which frames are interpolated.
    """

    def __init__(self, source: Source, group: Group, trajectory: Trajectory, n: int) -> None:
        """Merge `n` sub-exposures along the global motion; fewer if the group has fewer frames."""
        self._group, self._trajectory = group, trajectory
        self._frames = WeightedFrames(source, group)
        self._weights = halved(self._frames.weights) if self._frames.weights.size else self._frames.weights
        self._onto = to_exposure(group, trajectory, SCALE)
        height, width = source.info.frame_shape
        self.shape, self.response = (height // 2, width // 2), source.response
        self._halved = lru_cache(max(1, _CACHE_BYTES // (height * width)))(lambda span: halved(self._frames(span)))
        self._chunks = chunks_of(group.span, trajectory, source.info.frame_shape, _TOLERANCE_PX)
        self._trusted = np.ones(self.shape, np.float32)
        self._divide(n)
        to_image = self._to_image(np.array([chunk.homography for chunk in self._chunks]))
        places = np.stack(np.meshgrid(*(np.arange(0, side, max(1, side // _PLACES)) for side in self.shape[::-1])), axis=-1)
        found = transform_points(to_image, places.reshape(-1, 2))
        fraction = found - np.floor(found)
        self.spread = float(np.mean(fraction * (1 - fraction)))

    def _divide(self, n: int) -> None:
        """Merge `n` sub-exposures along the global motion."""
        self.spans, self.reference = parts_of(self._group, n)
        nothing = PhotonSum(*np.zeros((2, *self.shape), np.float32))
        self.sums = [nothing] * len(self.spans)
        self.sums = self.along(MotionField.zero(self.shape), np.ones(self.shape, np.bool_))

    def divided(self, n: int) -> SubExposures:
        """Return the same group as another number of sub-exposures."""
        other = copy(self)
        other._divide(n)
        return other

    def cropped(self, box: tuple[slice, slice]) -> SubExposures:
        """Return the same sub-exposures on some rows and columns of the grid."""
        crop = copy(self)
        crop._onto = translation(-box[1].start, -box[0].start) @ self._onto
        crop.sums = [
            PhotonSum(np.ascontiguousarray(each.counts[box]), np.ascontiguousarray(each.weight[box])) for each in self.sums
        ]
        crop.shape = crop.sums[0].counts.shape[0], crop.sums[0].counts.shape[1]
        crop._trusted = np.ones(crop.shape, np.float32)
        return crop

    def joined(self, sums: Sequence[PhotonSum], n: int) -> Joined:
        """Join the sums of all sub-exposures to `n` longer ones."""
        groups = divided(len(self.spans), n)
        times = [self.elapsed((self.spans[each.start].start + self.spans[each.stop - 1].stop - 1) / 2) for each in groups]
        reference = next(place for place, each in enumerate(groups) if self.reference in each)
        return Joined([_total_of(sums[each.start : each.stop]) for each in groups], times, reference)

    def smoothed(self, photons: PhotonSum, blur_px: float) -> Smoothed:
        """Blur a sub-exposure by some px of a frame, and stabilise its noise."""
        return smoothed(photons, self.response, blur_px, SCALE, self.spread)

    def elapsed(self, instant: float) -> float:
        """Return the time since the reference instant, as a share of the longer part of the group before or after it."""
        span, reference = self._group.span, self._group.reference
        return (instant - reference) / max(reference - span.start, span.stop - 1 - reference, 1)

    def along(self, field: MotionField, where: BoolArray, others: Sequence[PhotonSum] | None = None) -> list[PhotonSum]:
        """Merge some pixels, (H, W), along the global motion and a field in px of the grid; `others` are the sums elsewhere."""
        merged, unwanted = [], np.zeros((0, 0), np.float32)
        fastest_px = self.fastest_px(field, where)
        for span, other in zip(self.spans, others or self.sums, strict=True):
            counts, weight = (np.where(where, np.float32(0), each) for each in (other.counts, other.weight))
            sums = Sums(counts, weight, unwanted)
            for chunk, motion in self.moving(clipped(self._chunks, span, self._trajectory), field, fastest_px, _TOLERANCE_PX):
                to_image = self._to_image(chunk.homography)
                summed = Frames(self._halved(chunk.span), self._weights, float(len(chunk.span)))
                add_along(summed, to_image, Moved(where, (1.0, 0, 0), motion, self._trusted), sums)
            merged.append(PhotonSum(counts, weight))
        return merged

    @staticmethod
    def fastest_px(field: MotionField, where: BoolArray) -> float:
        """Return the 95th percentile of the speeds of some pixels, (H, W), in px of a frame per unit of time."""
        step = _SAMPLED if where[::_SAMPLED, ::_SAMPLED].any() else 1
        sample = MotionField(field.coefficients[:, ::step, ::step])
        return float(np.percentile(sample.way_px[where[::step, ::step]], _MOST)) / SCALE

    def moving(
        self, chunks: Sequence[Chunk], field: MotionField, fastest_px: float, tolerance_px: float
    ) -> Iterator[tuple[Chunk, Image]]:
        """Divide the chunks of a sub-exposure so that a field moves by less than a tolerance within each.

        Yields each with the displacement at its centre, (H, W, 2); the field is linear in time within a sub-exposure.
        """
        finer: list[Chunk] = []
        for chunk in chunks:
            way_px = fastest_px * abs(self.elapsed(chunk.span.stop) - self.elapsed(chunk.span.start))
            spans = equal_spans(chunk.span, math.ceil(way_px / tolerance_px))
            homographies = self._trajectory.at([span.centre for span in spans]) if len(spans) > 1 else [chunk.homography]
            finer += map(Chunk, spans, homographies)
        times = [self.elapsed(chunk.span.centre) for chunk in finer]
        first = field.at(times[0])
        way = field.at(times[-1]) - first if len(times) > 1 else first
        for chunk, time in zip(finer, times, strict=True):
            share = 0.0 if time == times[0] else (time - times[0]) / (times[-1] - times[0])
            yield chunk, first + np.float32(share) * way if share else first

    def _to_image(self, homographies: FloatArray) -> FloatArray:
        """Return the maps of pixels of the grid to halved frames."""
        return rescaling(SCALE) @ inverse(self._onto @ homographies)


def halved(image: Image) -> Image:
    """Average two by two pixels; a last odd row or column is left out."""
    height, width = image.shape[0] // 2, image.shape[1] // 2
    return np.asarray(cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _total_of(sums: Sequence[PhotonSum]) -> PhotonSum:
    """Add sums up."""
    counts, weight = sums[0].counts.copy(), sums[0].weight.copy()
    for each in sums[1:]:
        counts += each.counts
        weight += each.weight
    return PhotonSum(counts, weight)


def smoothed(photons: PhotonSum, response: Response, blur_px: float, scale: float, spread: float) -> Smoothed:
    """Blur a sub-exposure by a Gaussian in px of a frame, at `scale` px per px of a frame, and stabilise its noise."""
    counts, weight = (blurred(each, blur_px * scale) for each in (photons.counts, photons.weight))
    mean, frames = np.empty_like(counts), np.empty_like(counts)
    area = noise_area_px2(blur_px, scale, spread)
    # Where weights are uneven, as at a border, the blur shows the surroundings on one side.
    steepest = _SHIFT_PX / blur_px**2
    mean_of_seen(counts, weight, _SEEN * max(float(photons.weight.max()), 1.0), steepest, area, mean, frames)
    values = response.stabilised(response.flux(mean, np.maximum(frames, 1)), np.maximum(frames, 1))
    return Smoothed(np.where(frames > 0, values, np.float32(0)), frames)


def noise_area_px2(blur_px: float, scale: float, spread: float) -> float:
    """Return the number of pixels of a frame whose average has the noise of a smoothed pixel; arguments as in `smoothed`.

    Along an axis, noise is lowered by the sum of the squares of the kernel. Interpolation at a fraction f of a pixel takes `2 f
    (1 - f)` of it from the products of neighbours.
    """
    kernel = cv2.getGaussianKernel(2 * math.ceil(_REACH * blur_px * scale) + 1, blur_px * scale)[:, 0]
    squares, products = float(kernel @ kernel), float(kernel[1:] @ kernel[:-1])
    return float((squares - 2 * spread * (squares - products)) * scale) ** -2
