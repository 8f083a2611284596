"""Sub-exposures of a group: short parts of it, merged along the global motion or along a field beyond it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import (
    FloatArray,
    FrameSpan,
    Group,
    LinearlyCorrectedSource,
    Response,
    Source,
    Trajectory,
    WeightedSource,
)
from photonpano.geometry import apply, inverse, translation
from photonpano.merging import Chunk, CountsCache, PhotonSum, accumulate, chunks_of, clipped, divided
from photonpano_core.dense_motion.field import MotionField
from photonpano_core.dense_motion.warping import add_along
from photonpano_core.photon_mle import exposure_shape, to_exposure

Image = NDArray[np.float32]

_PLACES = 5
"""Places along an axis, about, at which the blur of interpolation is looked at."""
_CACHE_BYTES = 64 * 1024**2
"""Memory for sums of frames that are warped again in each round."""
_SHIFT_PX = 0.2
"""Largest displacement, by uneven weights, of what a smoothed pixel shows, in px of a frame."""
_MOST = 99.0
"""Percentile of the speeds of a field by which frames are summed."""
_SEEN = 0.1
"""A pixel is seen by a sub-exposure if this share of its frames, smoothed, shows it."""


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A sub-exposure on the scale on which photon noise is uniform.

    Attributes:
        values: (H, W) float32, stabilised flux of the smoothed counts; 0 where unseen.
        frames: (H, W) float32, number of frames of one pixel whose noise equals that of the smoothed value; 0 where unseen.
    """

    values: Image
    frames: Image

    def squared_difference(self, other: Smoothed, response: Response) -> Image:
        """Return (H, W): the squared difference, in units of its photon noise; 0 where one of both is unseen."""
        seen = (self.frames > 0) & (other.frames > 0)
        mine, others = (response.stabilised_std(np.maximum(each.frames, 1)) ** 2 for each in (self, other))
        difference = (self.values - other.values) ** 2 / (mine + others)
        return np.where(seen, difference, np.float32(0)).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Sub-exposures that are joined to longer ones.

    Attributes:
        sums: counts and weights of each.
        times: the middle of each: see `SubExposures.elapsed`.
        reference: index of the one that contains the reference instant.
    """

    sums: list[PhotonSum]
    times: list[float]
    reference: int


class SubExposures:
    """The sub-exposures of one group, on the grid of its exposure.

    Attributes:
        spans: the frames of each, in order.
        shape: (height, width) of the grid.
        scale: pixels of the grid per pixel of a frame.
        sums: counts and weights of each along the global motion.
        reference: index of the one that contains the reference instant.
        blur_px2: variance of the bilinear kernels, on average, in px of a frame squared: interpolation blurs noise by it.
    """

    def __init__(self, source: Source, group: Group, trajectory: Trajectory, scale: float, n: int, tolerance_px: float) -> None:
        """Merge along the global motion.

        Args:
            source: the capture.
            group: its frames are divided.
            trajectory: the global motion.
            scale: pixels of the grid per pixel of a frame.
            n: number of sub-exposures; fewer if the group has fewer frames.
            tolerance_px: motion within which frames are summed before they are warped.
        """
        self._source, self._group, self._trajectory = source, group, trajectory
        self._onto = to_exposure(group, trajectory, scale)
        self._cache = CountsCache(source, _CACHE_BYTES)
        self._corrected = source.corrected if isinstance(source, LinearlyCorrectedSource) else None
        self._worth = worth_of(source)
        self.shape, self.scale = exposure_shape(source, scale), scale
        start = group.span.start
        self.spans = [FrameSpan(start + part.start, start + part.stop) for part in divided(len(group.span), n)]
        self.reference = next(place for place, span in enumerate(self.spans) if group.reference < span.stop)
        chunks = self._chunks(tolerance_px)
        self.sums = [accumulate(source, each, self._onto, self.shape, counts_of=self._cache) for each in chunks]
        to_image = inverse(self._onto @ np.array([chunk.homography for each in chunks for chunk in each]))
        self.blur_px2 = _interpolation_blur(to_image, self.shape)

    def cropped(self, box: tuple[slice, slice]) -> SubExposures:
        """Return the same sub-exposures on some rows and columns of the grid."""
        crop = copy(self)
        crop._onto = translation(-box[1].start, -box[0].start) @ self._onto
        crop.sums = [
            PhotonSum(np.ascontiguousarray(each.counts[box]), np.ascontiguousarray(each.weight[box])) for each in self.sums
        ]
        crop.shape = crop.sums[0].counts.shape[0], crop.sums[0].counts.shape[1]
        return crop

    def joined(self, sums: Sequence[PhotonSum], n: int) -> Joined:
        """Join sub-exposures to `n` longer ones.

        Args:
            sums: of all sub-exposures.
            n: number of longer ones, at most that of all.
        """
        groups = divided(len(self.spans), n)
        times = [self.elapsed((self.spans[each.start].start + self.spans[each.stop - 1].stop - 1) / 2) for each in groups]
        reference = next(place for place, each in enumerate(groups) if self.reference in each)
        return Joined([total_of(sums[each.start : each.stop]) for each in groups], times, reference)

    def smoothed(self, photons: PhotonSum, blur_px: float) -> Smoothed:
        """Blur a sub-exposure by some px of a frame, and stabilise its noise."""
        return smoothed(photons, self.response, blur_px, self.scale, self.blur_px2)

    @property
    def response(self) -> Response:
        """The camera's response."""
        return self._source.response

    def elapsed(self, instant: float) -> float:
        """Return the time since the reference instant, as a share of the longer part of the group before or after it."""
        span, reference = self._group.span, self._group.reference
        return (instant - reference) / max(reference - span.start, span.stop - 1 - reference, 1)

    def along(self, field: MotionField, where: NDArray[np.bool_], tolerance_px: float) -> list[PhotonSum]:
        """Merge along the global motion and a field, each photon interpolated once.

        Args:
            field: the motion beyond the global one.
            where: (H, W) pixels that are merged again, one at least; elsewhere the sums are those along the global motion.
            tolerance_px: motion within which frames are summed before they are warped, in px of a frame.
        """
        places = np.array(np.nonzero(where)[::-1], np.float64)
        motion = np.ascontiguousarray(field.coefficients[:, :, where])
        # Frames between which the field moves by less than the tolerance are summed as well.
        fastest_px = float(np.percentile(field.way_px[where], _MOST)) / self.scale
        merged = []
        for chunks, total in zip(self._chunks(tolerance_px), self.sums, strict=True):
            counts, weight = np.zeros((2, places.shape[1]), np.float32)
            for chunk in chunks:
                way_px = fastest_px * abs(self.elapsed(chunk.span.stop) - self.elapsed(chunk.span.start))
                for part in self._divided(chunk, math.ceil(way_px / tolerance_px)):
                    self._add(part, places, motion, counts, weight)
            image = PhotonSum(total.counts.copy(), total.weight.copy())
            image.counts[where], image.weight[where] = counts, weight
            merged.append(image)
        return merged

    def _chunks(self, tolerance_px: float) -> list[tuple[Chunk, ...]]:
        """Return the chunks of each sub-exposure along the global motion."""
        chunks = chunks_of(self._group.span, self._trajectory, self._source.info.frame_shape, tolerance_px)
        return [clipped(chunks, span, self._trajectory) for span in self.spans]

    def _divided(self, chunk: Chunk, parts: int) -> list[Chunk]:
        if parts < 2:
            return [chunk]
        start = chunk.span.start
        spans = [FrameSpan(start + part.start, start + part.stop) for part in divided(len(chunk.span), parts)]
        return [Chunk(span, self._trajectory.at([span.centre])[0]) for span in spans]

    def _add(self, chunk: Chunk, places: FloatArray, motion: Image, counts: Image, weight: Image) -> None:
        n_frames, summed = len(chunk.span), self._cache(chunk.span)
        lit = (self._corrected(summed, n_frames) if self._corrected else summed).astype(np.float32, copy=False)
        if self._worth.size:
            lit = lit * self._worth
        to_image, elapsed = inverse(self._onto @ chunk.homography), self.elapsed(chunk.span.centre)
        add_along(lit, self._worth, float(n_frames), to_image, places, motion, elapsed, counts, weight)


def _interpolation_blur(to_image: FloatArray, shape: tuple[int, int]) -> float:
    """Return the mean variance along an axis, `f (1 - f)` at the fraction f of a pixel, of bilinear kernels.

    Args:
        to_image: (N, 3, 3), pixels of the grid to pixels of frames.
        shape: (height, width) of the grid.
    """
    places = np.stack(np.meshgrid(*(np.arange(0, side, max(1, side // _PLACES)) for side in shape[::-1])), axis=-1)
    found = apply(to_image, places.reshape(-1, 2))
    fraction = found - np.floor(found)
    return float(np.mean(fraction * (1 - fraction)))


def worth_of(source: Source) -> Image:
    """Return what a frame of each pixel is worth, 0 for a masked one: (H, W); (0, 0) if it is 1 for all."""
    if isinstance(source, WeightedSource):
        return np.where(source.valid, source.weights(), np.float32(0))
    return np.zeros((0, 0), np.float32) if source.valid.all() else source.valid.astype(np.float32)


def total_of(sums: Sequence[PhotonSum]) -> PhotonSum:
    """Add sums up."""
    counts, weight = sums[0].counts.copy(), sums[0].weight.copy()
    for each in sums[1:]:
        counts += each.counts
        weight += each.weight
    return PhotonSum(counts, weight)


def smoothed(photons: PhotonSum, response: Response, blur_px: float, scale: float, interpolation_px2: float) -> Smoothed:
    """Blur a sub-exposure, and stabilise its noise.

    Args:
        photons: the sub-exposure.
        response: the camera's response.
        blur_px: standard deviation of the Gaussian, in px of a frame.
        scale: pixels of the sub-exposure per pixel of a frame.
        interpolation_px2: variance of the kernel that has blurred the noise before: see `SubExposures`.
    """
    counts, weight = (blurred(each, blur_px * scale) for each in (photons.counts, photons.weight))
    seen = weight > _SEEN * max(float(photons.weight.max()), 1.0)
    norm = np.where(seen, weight, np.float32(1))
    # Where weights are uneven, as at a border, the blur shows the surroundings on one side.
    shift_px = (blur_px**2 * scale) * np.hypot(*np.gradient(weight)) / norm
    seen &= shift_px < _SHIFT_PX
    # The square of a Gaussian is a narrower one. Noise is independent between pixels of frames, but for their interpolation.
    frames = np.maximum(norm * np.float32(4 * math.pi * (blur_px**2 + interpolation_px2)), np.float32(1))
    mean = np.where(seen, np.maximum(counts, 0) / norm, np.float32(0)).astype(np.float32)
    values = response.stabilised(response.flux(mean, frames), frames)
    return Smoothed(np.where(seen, values, np.float32(0)), np.where(seen, frames, np.float32(0)))


def blurred(image: Image, blur_px: float) -> Image:
    """Blur with a Gaussian; the image is 0 outside of its border."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_CONSTANT), np.float32)
