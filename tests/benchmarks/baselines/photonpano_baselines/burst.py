"""Quanta burst photography in one shot, a baseline: `burst` (after Ma et al. 2020; Hasinoff et al. 2016).

The paper compares with it in supplement S1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano import FloatArray, FrameSpan, Group, Response, Source, Trajectory, VirtualExposure
from photonpano.compiling import compiled
from photonpano.merging import PhotonSum
from photonpano_baselines.configs import BurstConfig
from photonpano_core.mergers import equal_spans, exposure_of, parts_of, require_plain
from photonpano_core.motion_fields import Frames, WeightedFrames, count_variance, halved, rescaled, smoothed

_DETAIL_PX = 1.0  # blur of blocks before they are compared, in px
_LEVELS = 4  # levels of the pyramid, each of half the size of the one before
_RADIUS = 4, 2  # search around the start, in px: at the coarsest level, and at each other
_RESTS = 2.5  # a block is static if no patch agrees better elsewhere by this much, in units of the photon noise
_TOLERANCE = 8.0  # squared difference of a frequency that costs half of its weight, in units of its photon noise
Image = NDArray[np.float32]

_ROUNDED_UP = 1 + 1e-6


class BurstMerger:
    """Aligns blocks of frames patch by patch with the block around the reference instant, once, and merges them.

    It ignores the trajectory. Each block is searched coarse to fine around the motion that the blocks before it extrapolate.
    Frames are warped by the motion of the blocks, interpolated linearly. Patches are merged in the frequency domain by a Wiener
    filter: where a block differs from the reference by more than noise, it gets less weight. The weight of a pixel is the
    number of frames that showed it; what the filter leaves out is not subtracted.
    """

    def __init__(self, config: BurstConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`. Raises an `InputError` if the lens distorts, or the light changes."""
        del trajectory
        require_plain(source, "burst")
        burst = _Burst(source, group, self._config)
        photons = burst.merged(burst.motion())
        return exposure_of(photons if scale == 1 else rescaled(photons, scale), source, group, scale)


class _Burst:
    def __init__(self, source: Source, group: Group, config: BurstConfig) -> None:
        self._source, self._group, self._config = source, group, config
        self._counts = WeightedFrames(source, group)
        weights = self._counts.weights
        self._weights = weights if weights.size else np.ones(source.info.frame_shape, np.float32)
        self._spans, self._reference = parts_of(group, round(len(group.span) / config.block_frames))
        self._grid = PatchGrid(source.info.frame_shape, config.patch_px)

    def motion(self) -> FloatArray:
        """Return the displacement of each patch at the middle of each block from the reference block: (K, rows, columns, 2)."""
        images, noise = zip(*[self._image(span) for span in self._spans], strict=True)
        found = np.zeros((len(self._spans), *self._grid.n_patches, 2))
        fixed = self._reference
        for direction in (1, -1):
            place = fixed + direction
            while 0 <= place < len(self._spans):
                before, earlier = place - direction, place - 2 * direction
                start = found[before] if before == fixed else 2 * found[before] - found[earlier]
                variance = noise[place] + noise[fixed]
                found[place] = aligned(images[fixed], images[place], self._grid, start, variance)
                place += direction
        return found

    def _image(self, span: FrameSpan) -> tuple[Image, float]:
        """Return a block as it lies, on the scale of uniform noise, and its variance there."""
        photons = PhotonSum(self._counts(span), self._weights * np.float32(len(span)))
        image = smoothed(photons, self._source.response, _DETAIL_PX, 1.0, 0.0)
        seen = image.frames > 0
        values = np.where(seen, image.values, image.values[seen].mean() if seen.any() else 0).astype(np.float32)
        frames = float(np.median(image.frames[seen])) if seen.any() else 1.0
        return values, float(self._source.response.stabilised_std(frames)) ** 2

    def merged(self, motion: FloatArray) -> PhotonSum:
        """Merge the blocks along the motion of their patches."""
        middles = [span.centre for span in self._spans]
        there = at_instant(middles, motion, self._group.reference)
        side, shape = self._grid.side, self._grid.n_patches
        counts = np.zeros((len(self._spans), *shape, side, side), np.float32)
        weight = np.zeros_like(counts)
        for place, span in enumerate(self._spans):
            way = at_instant(middles, motion, span.stop - 1) - at_instant(middles, motion, span.start)
            way_px = float(np.percentile(np.hypot(*np.moveaxis(way, -1, 0)), 90))
            for chunk in equal_spans(span, math.ceil(way_px / self._config.tolerance_px)):
                shifts = at_instant(middles, motion, chunk.centre) - there
                summed = Frames(self._counts(chunk), self._weights, float(len(chunk)))
                add_patches(summed, shifts, self._grid.step, counts[place], weight[place])
        mean = wiener_mean(counts, weight, self._reference, self._source.response)
        frames = weight.sum(axis=0)
        return PhotonSum(self._grid.joined(mean * frames), self._grid.joined(frames))


def aligned(fixed: Image, moving: Image, grid: PatchGrid, start: FloatArray, variance: float) -> FloatArray:
    """Find the patches of `fixed` in `moving`, (H, W) on the scale of uniform noise: displacements (rows, columns, 2).

    The search goes coarse to fine from the displacements `start`, x and y. `variance` is that of the noise of the difference.
    Returns zeros if no patch agrees significantly better elsewhere than at its own place.
    """
    pyramid = [(fixed, moving)]
    while len(pyramid) < _LEVELS and min(pyramid[-1][0].shape) >= 4 * grid.side:
        pyramid.append((halved(pyramid[-1][0]), halved(pyramid[-1][1])))
    found, costs = np.zeros((0, 0, 2)), np.zeros((0, 0, 2), np.float32)
    for level in reversed(range(len(pyramid))):
        here = PatchGrid(pyramid[level][0].shape, grid.side)
        starts = [_resized(start, here.n_patches) / 2**level]
        if found.size:
            starts += [_resized(found, here.n_patches, shift) * 2 for shift in (-1, 0, 1)]
        found, costs = np.zeros((*here.n_patches, 2)), np.zeros((*here.n_patches, 2), np.float32)
        radius = _RADIUS[0] if level == len(pyramid) - 1 else _RADIUS[1]
        search(*pyramid[level], grid.side, np.rint(starts).astype(np.int64), radius, found, costs)
        found = np.stack([cv2.medianBlur(np.ascontiguousarray(found[..., axis], np.float32), 3) for axis in range(2)], axis=-1)
        found = found.astype(np.float64)
    both = np.isfinite(costs).all(axis=-1)
    rests = not (costs[both, 0] - costs[both, 1] > _RESTS * variance).any()
    return np.zeros_like(found) if rests else found


def _resized(motion: FloatArray, n_patches: tuple[int, int], shift: int = 0) -> FloatArray:
    """Return the motion of the nearest patches of a grid of another size, or of patches `shift` steps from these."""
    places = [
        np.clip(np.rint(np.linspace(0, length - 1, n)).astype(int) + shift, 0, length - 1)
        for length, n in zip(motion.shape[:2], n_patches, strict=True)
    ]
    return np.asarray(motion[np.ix_(*places)])


def at_instant(middles: list[float], motion: FloatArray, instant: float) -> FloatArray:
    """Interpolate the motion (K, ...) of blocks linearly between their middles, in frames, or with the velocity beyond them."""
    if len(middles) == 1:
        return np.asarray(motion[0])
    after = int(np.clip(np.searchsorted(middles, instant), 1, len(middles) - 1))
    share = (instant - middles[after - 1]) / (middles[after] - middles[after - 1])
    return np.asarray((1 - share) * motion[after - 1] + share * motion[after])


def wiener_mean(counts: Image, weight: Image, reference: int, response: Response) -> Image:
    """Merge sums of blocks of patches, (K, rows, columns, side, side), in the frequency domain to mean counts of a frame.

    D is the difference of a frequency of a block from that of the reference block, and s^2 the variance of D from photon noise.
    The block is replaced by the reference by the share `|D|^2 / (|D|^2 + 8 s^2)`. Where that is masked, it is the mean of all.
    """
    unseen = _mean(counts.sum(axis=0), weight.sum(axis=0), np.float32(0))
    fixed = _mean(counts[reference], weight[reference], unseen)
    frames = weight.mean(axis=(-2, -1))
    noise = count_variance(fixed.mean(axis=(-2, -1)), response)
    own = fft.rfft2(fixed)
    total, n = own * frames[reference, ..., None, None], frames[reference].copy()
    for place in range(len(counts)):
        if place == reference:
            continue
        other = fft.rfft2(_mean(counts[place], weight[place], fixed))
        variance = noise / np.maximum(frames[place], 1) + noise / np.maximum(frames[reference], 1)
        tolerated = (np.float32(_TOLERANCE * fixed.shape[-1] ** 2) * variance)[..., None, None]
        difference = own - other
        power = np.abs(difference) ** 2
        other += power / (power + np.maximum(tolerated, np.float32(1e-12))) * difference
        total += other * frames[place, ..., None, None]
        n += frames[place]
    total /= np.maximum(n, np.float32(1e-6))[..., None, None]
    return np.maximum(fft.irfft2(total, s=fixed.shape[-2:]), 0).astype(np.float32)


def _mean(counts: Image, weight: Image, unseen: NDArray[np.float32] | np.float32) -> Image:
    """Return the mean count of a frame, and `unseen` where there is none."""
    seen = weight > 1e-3
    return np.where(seen, counts / np.where(seen, weight, np.float32(1)), unseen).astype(np.float32)


@dataclass(frozen=True, slots=True)
class PatchGrid:
    """Patches at steps of half a side, from half a side before the image, so that each pixel lies in four."""

    shape: tuple[int, int]  # (height, width) of the image
    side: int  # of a patch, in px, even

    @property
    def step(self) -> int:
        """Distance of neighbouring patches, in px."""
        return self.side // 2

    @property
    def n_patches(self) -> tuple[int, int]:
        """Number of patches along y and along x."""
        return -(-self.shape[0] // self.step) + 1, -(-self.shape[1] // self.step) + 1

    def joined(self, patches: Image) -> Image:
        """Blend patches, (rows, columns, side, side), with windows of raised cosines, which add up to 1: (H, W)."""
        half = self.step
        window = 0.5 - 0.5 * np.cos(np.pi * (np.arange(self.side) + 0.5) / half)
        # Slightly more than 1, so that rounding does not turn one frame into less.
        patches = patches * (np.outer(window, window) * _ROUNDED_UP).astype(np.float32)
        rows, columns = self.n_patches
        image = np.zeros(((rows + 1) * half, (columns + 1) * half), np.float32)
        for down in range(2):
            for right in range(2):
                # The quarters of all patches lie side by side.
                quarters = patches[:, :, down * half : (down + 1) * half, right * half : (right + 1) * half]
                quarters = quarters.swapaxes(1, 2).reshape(rows * half, columns * half)
                image[down * half : (down + rows) * half, right * half : (right + columns) * half] += quarters
        return np.ascontiguousarray(image[half : half + self.shape[0], half : half + self.shape[1]])


@compiled
def add_patches(summed: Frames, shifts: NDArray[np.float64], step: int, counts: Image, weight: Image) -> None:
    """Add an image to patches, shifted and interpolated bilinearly; the image is 0 outside of its border.

    The pixel p of a patch is read at p + shift, for `shifts` x and y (rows, columns, 2). `counts` and `weight` are (rows,
    columns, side, side), added to; `step` is the distance of neighbouring patches, in px.
    """
    image, weights = summed.image, summed.weights
    height, width = image.shape
    rows, columns, side = counts.shape[0], counts.shape[1], counts.shape[2]
    for i in range(rows):
        for j in range(columns):
            x, y = (j - 1) * step + shifts[i, j, 0], (i - 1) * step + shifts[i, j, 1]
            left, top = int(np.floor(x)), int(np.floor(y))
            a, b = np.float32(x - left), np.float32(y - top)
            one = np.float32(1)
            for row in range(side):
                for corner in range(4):
                    down, right = corner // 2, corner % 2
                    source, start = top + row + down, left + right
                    first, last = max(0, -start), min(side, width - start)
                    if not 0 <= source < height or first >= last:
                        continue
                    factor = (b if down else one - b) * (a if right else one - a)
                    frames = factor * np.float32(summed.number)
                    lit, seen = image[source, start + first : start + last], weights[source, start + first : start + last]
                    to, of = counts[i, j, row, first:last], weight[i, j, row, first:last]
                    for t in range(len(to)):
                        to[t] += factor * lit[t]
                        of[t] += frames * seen[t]


@compiled
def search(
    fixed: Image, moving: Image, side: int, starts: NDArray[np.int64], radius: int, found: NDArray[np.float64], costs: Image
) -> None:
    """Find each patch of `fixed`, (h, w), in `moving`, by the mean squared difference over the pixels that both show.

    The search goes on around the best of `starts`, (S, rows, columns, 2) displacements x and y, up to `radius` along each axis.
    Writes the displacements, between pixels by a parabola, and the costs of no displacement and of the one found, infinite
    without overlap.
    """
    step = side // 2
    around = np.empty((2 * radius + 3, 2 * radius + 3))
    for i in range(found.shape[0]):
        for j in range(found.shape[1]):
            x, y = (j - 1) * step, (i - 1) * step
            best, at_x, at_y = np.inf, 0, 0
            for s in range(len(starts)):
                cost = _difference(fixed, moving, x, y, side, starts[s, i, j, 0], starts[s, i, j, 1])
                if cost < best:
                    best, at_x, at_y = cost, starts[s, i, j, 0], starts[s, i, j, 1]
            least, row, column = np.inf, radius + 1, radius + 1
            for down in range(2 * radius + 3):
                for right in range(2 * radius + 3):
                    cost = _difference(fixed, moving, x, y, side, at_x + right - radius - 1, at_y + down - radius - 1)
                    around[down, right] = cost
                    inside = 1 <= down <= 2 * radius + 1 and 1 <= right <= 2 * radius + 1
                    if inside and cost < least:
                        least, row, column = cost, down, right
            found[i, j, 0] = at_x + column - radius - 1 + _vertex(around[row, column - 1], least, around[row, column + 1])
            found[i, j, 1] = at_y + row - radius - 1 + _vertex(around[row - 1, column], least, around[row + 1, column])
            costs[i, j, 0], costs[i, j, 1] = _difference(fixed, moving, x, y, side, 0, 0), least


@compiled
def _difference(fixed: Image, moving: Image, x: int, y: int, side: int, right: int, down: int) -> float:
    """Return the mean squared difference of a patch and a displaced one; infinite if they share under half of their pixels."""
    height, width = fixed.shape
    first, last = max(0, x, -right), min(width, x + side, width - right)
    total, n = np.float32(0), 0
    for row in range(max(0, y, -down), min(height, y + side, height - down)):
        if first >= last:
            break
        mine, other = fixed[row, first:last], moving[row + down, first + right : last + right]
        for t in range(len(mine)):
            total += (mine[t] - other[t]) ** 2
        n += len(mine)
    inside = max(0, min(width, x + side) - max(0, x)) * max(0, min(height, y + side) - max(0, y))
    if n == 0 or 2 * n < inside:
        return np.inf
    return float(total) / n


@compiled
def _vertex(before: float, least: float, after: float) -> float:
    """Return where a parabola through three costs is least, from -0.5 to 0.5."""
    if not (least < before < np.inf and least < after < np.inf):
        return 0.0
    return float(0.5 * (before - after) / (before - 2 * least + after))
