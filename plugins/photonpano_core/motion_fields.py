"""Dense fields of motion beyond the global one, compiled; and sub-exposures of a group, merged along them at half the size.

The motion of each pixel is a polynomial of time. The frames of a sub-exposure are corrected, weighted and summed, and their
sums rescaled, blurred, or sharpened where the noise of their photons allows it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, FrameSpan, Group, Response, Source, Trajectory, capture_of
from photonpano.compiling import compiled
from photonpano.geometry import inverse, rescaling, transform_points, translation
from photonpano.merging import Chunk, PhotonSum, chunks_of, clipped, divided
from photonpano_core.mergers import equal_spans, parts_of, to_exposure

Image = NDArray[np.float32]

_STEPS = 8  # line segments that approximate the path of a pixel
_MANY = 1e4  # frames for which the variance of a count is derived; it is then divided by them
_SHARE = np.float32(0.01)  # relative step of the numerical derivative
_WINDOW_PX = 1.5  # standard deviation of the window over which the Laplacian is compared with its noise, in px


@dataclass(frozen=True, slots=True, eq=False)
class MotionField:
    """Motion of each pixel of a grid beyond the global motion, as a polynomial of time that is 0 at the reference instant.

    Convention:
        What lies at the pixel p at the reference instant lies at `p + at(elapsed)` later, both along the global motion. Points
        are (x, y), integers are pixel centres. Time is relative to the longer part of the group before or after.
    """

    coefficients: Image  # (D, H, W, 2), in px of the grid: the displacement is `sum_d coefficients[d] elapsed^(d + 1)`

    @classmethod
    def zero(cls, shape: tuple[int, int]) -> MotionField:
        """Return a field without motion."""
        return cls(np.zeros((1, *shape, 2), np.float32))

    def at(self, elapsed: float) -> Image:
        """Return the displacement at a time: (H, W, 2), x and y in px of the grid."""
        displacement = np.empty(self.coefficients.shape[1:], np.float32)
        _value_of_each(self.coefficients.reshape(len(self.coefficients), -1), np.float32(elapsed), displacement.reshape(-1))
        return displacement

    @property
    def way_px(self) -> Image:
        """Length of the path of each pixel per unit of time, from -1 to 1: (H, W), in px of the grid."""
        places = [self.at(elapsed) for elapsed in np.linspace(-1, 1, _STEPS + 1)]
        ways = (after - before for before, after in pairwise(places))
        return np.asarray(sum(np.sqrt(way[..., 0] ** 2 + way[..., 1] ** 2) for way in ways) / 2, np.float32)

    def filled(self, known: BoolArray) -> MotionField:
        """Return the field in which each pixel moves as the nearest one that is known, (H, W)."""
        _, labels = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int64)
        places[labels[known]] = np.flatnonzero(known)
        return MotionField(np.stack([each.reshape(-1, 2)[places[labels]] for each in self.coefficients]))


@compiled
def add_moments(time: np.float32, value: Image, trust: Image, moments: Image, right: Image) -> None:
    """Add the values (H, W, 2) of pixels at a time, with weights (H, W), to the sums from which `fit_each` fits polynomials."""
    for row in range(trust.shape[0]):
        weights, xy = trust[row], value[row]
        power = time
        for d in range(len(moments)):
            power *= time
            to = moments[d, row]
            for i in range(len(to)):
                to[i] += power * weights[i]
        power = np.float32(1)
        for d in range(len(right)):
            power *= time
            into = right[d, row]
            for i in range(len(into)):
                into[i, 0] += power * weights[i] * xy[i, 0]
                into[i, 1] += power * weights[i] * xy[i, 1]


@compiled
def fit_each(moments: Image, right: Image, prior: float, where: BoolArray, found: Image) -> None:
    """Solve a least-squares fit of polynomials without a constant term at some pixels, (H, W), by Cholesky decomposition.

    `moments` (2 D - 1, H, W) are weighted sums of the powers 2 to 2 D of time, `right` (D, H, W, 2) those of the powers 1 to D
    times x and y. `prior` is added to the diagonal. Writes the coefficients of the powers 1 to D, (D, H, W, 2).
    """
    degree = right.shape[0]
    lower, x = np.zeros((degree, degree)), np.zeros((degree, 2))
    for row in range(where.shape[0]):
        for column in range(where.shape[1]):
            if not where[row, column]:
                continue
            for i in range(degree):
                for j in range(i + 1):
                    total = float(moments[i + j, row, column]) + (prior if i == j else 0.0)
                    for k in range(j):
                        total -= lower[i, k] * lower[j, k]
                    # float32 moments may be singular by rounding errors.
                    lower[i, j] = np.sqrt(max(total, 0.1 * prior)) if i == j else total / lower[j, j]
            for axis in range(2):
                for i in range(degree):
                    total = float(right[i, row, column, axis])
                    for k in range(i):
                        total -= lower[i, k] * x[k, axis]
                    x[i, axis] = total / lower[i, i]
                for i in range(degree - 1, -1, -1):
                    total = x[i, axis]
                    for k in range(i + 1, degree):
                        total -= lower[k, i] * x[k, axis]
                    x[i, axis] = total / lower[i, i]
                for i in range(degree):
                    found[i, row, column, axis] = x[i, axis]


@compiled
def _value_of_each(coefficients: Image, time: np.float32, found: Image) -> None:
    """Evaluate polynomials with coefficients (D, N) of the powers 1 to D of time, by Horner's rule, into `found` (N,)."""
    found[:] = 0
    for degree in range(len(coefficients) - 1, -1, -1):
        own = coefficients[degree]
        for i in range(len(found)):
            found[i] = time * (found[i] + own[i])


class Frames(NamedTuple):
    """A sum of frames."""

    image: Image  # (h, w) sum
    weights: Image  # (h, w) of a frame of each pixel, from 0 to 1; (0, 0) if it is 1 for all
    number: float


class Moved(NamedTuple):
    """Motion of the pixels of a grid beyond a homography, in cells of a coarser or finer grid."""

    where: BoolArray  # (H, W) pixels of the grid that are added to
    # cells per pixel, and the row and the column of the first cell. Pixels in one cell move alike
    cells: tuple[float, int, int]
    motion: Image  # (h', w', 2), x and y by which cells are displaced, in cells
    trust: Image  # (h', w') weight of the image in each cell


class Sums(NamedTuple):
    """Sums that `add_along` adds to."""

    counts: Image  # (H, W) sums
    weight: Image  # (H, W) numbers of frames
    # (H, W) variances of the blur of interpolation, mean of x and y in px^2, times numbers of frames; (0, 0) for none
    blur: Image


@compiled
def add_along(summed: Frames, to_image: FloatArray, moved: Moved, sums: Sums) -> None:
    """Add a sum of frames to some pixels of a grid, which (3, 3) maps to the image, bilinearly; 0 outside of its border."""
    image, weights, where, trust = summed.image, summed.weights, moved.where, moved.trust
    counts, weight, blur = sums.counts, sums.weight, sums.blur
    scale, first_row, first_column = moved.cells
    height, width = image.shape
    frames, per_cell, last = np.float32(summed.number), 1 / scale, where.shape[1]
    steps = np.arange(last)
    columns = np.minimum(np.maximum(((steps + 0.5) * scale).astype(np.int64) - first_column, 0), trust.shape[1] - 1)
    us, vs, shares = np.empty(last), np.empty(last), np.empty(last, np.float32)
    for row in range(where.shape[0]):
        inside, first, stop = where[row], 0, last
        while first < stop and not inside[first]:
            first += 1
        while stop > first and not inside[stop - 1]:
            stop -= 1
        if first == stop:
            continue
        cell = min(max(int((row + 0.5) * scale) - first_row, 0), trust.shape[0] - 1)
        displaced, trusted = moved.motion[cell], trust[cell]
        for i in range(first, stop):
            at = columns[i]
            us[i], vs[i], shares[i] = i + per_cell * displaced[at, 0], row + per_cell * displaced[at, 1], trusted[at]
        _map(to_image, us[first:stop], vs[first:stop])
        into, of = counts[row], weight[row]
        for i in range(first, stop):
            u, v, share = us[i], vs[i], shares[i]
            if not (inside[i] and -1 < u < width and -1 < v < height):
                continue
            left, top = int(u + 1) - 1, int(v + 1) - 1
            a, b = np.float32(u - left), np.float32(v - top)
            if 0 <= left < width - 1 and 0 <= top < height - 1:
                into[i] += share * _between(image, top, left, a, b)
                seen = share * frames * (_between(weights, top, left, a, b) if weights.size else np.float32(1))
                of[i] += seen
                if blur.size:
                    blur[row, i] += seen * np.float32(0.5) * (a * (1 - a) + b * (1 - b))
                continue
            for down in range(2):
                for right in range(2):
                    y, x = top + down, left + right
                    if 0 <= y < height and 0 <= x < width:
                        part = share * (b if down else 1 - b) * (a if right else 1 - a)
                        into[i] += part * image[y, x]
                        of[i] += part * frames * (weights[y, x] if weights.size else np.float32(1))


@compiled
def _map(to_image: FloatArray, us: FloatArray, vs: FloatArray) -> None:
    """Replace places (x, y) on a grid by those in an image."""
    xx, xy, x1 = to_image[0, 0], to_image[0, 1], to_image[0, 2]
    yx, yy, y1 = to_image[1, 0], to_image[1, 1], to_image[1, 2]
    zx, zy, z1 = to_image[2, 0], to_image[2, 1], to_image[2, 2]
    for i in range(len(us)):
        x, y = us[i], vs[i]
        per_depth = 1 / (zx * x + zy * y + z1)
        us[i] = (xx * x + xy * y + x1) * per_depth
        vs[i] = (yx * x + yy * y + y1) * per_depth


@compiled
def _between(image: Image, top: int, left: int, a: np.float32, b: np.float32) -> np.float32:
    """Interpolate between four pixels, at fractions of a pixel to the right and down of the first."""
    upper = image[top, left] + a * (image[top, left + 1] - image[top, left])
    lower = image[top + 1, left] + a * (image[top + 1, left + 1] - image[top + 1, left])
    return np.float32(upper + b * (lower - upper))


@compiled
def mean_of_seen(counts: Image, weight: Image, least: float, steepest: float, area: float, mean: Image, frames: Image) -> None:  # noqa: PLR0917
    """Divide counts by weights, (H, W), where these exceed `least`, and their gradient is below `steepest` relative to them.

    Writes the mean count of a frame, and the frames of one pixel whose noise equals that of an average over `area` pixels, 1 or
    more; both 0 where unseen.
    """
    height, width = counts.shape
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        for column in range(width):
            left, right, here = max(column - 1, 0), min(column + 1, width - 1), weight[row, column]
            down = (weight[below, column] - weight[above, column]) / max(below - above, 1)
            along = (weight[row, right] - weight[row, left]) / max(right - left, 1)
            if here > least and down * down + along * along < (steepest * here) ** 2:
                mean[row, column] = max(counts[row, column], np.float32(0)) / here
                frames[row, column] = max(here * np.float32(area), np.float32(1))
            else:
                mean[row, column], frames[row, column] = 0, 0


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
