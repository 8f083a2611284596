"""Image pyramids of exposures, on the scale on which photon noise is uniform, and comparisons of their layers.

Two layers are compared by their similarity under a motion, by the part that follows a motion, and by the shifts under which
most of one fits the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from photonpano import BoolArray, FloatArray, Homography, VirtualExposure
from photonpano.compiling import compiled
from photonpano.geometry import run_from, sample_run, translation, visible_columns
from photonpano.locating import SMALLEST_SIDE, Follows, View, follows, view_pyramid
from photonpano.photometry import LOCAL_PX, Similarity, autocorrelation, similarity_of, without_local_mean
from photonpano_direct.alignment import buffers_of
from photonpano_direct.normal_equations import Image, Layer, differentiate, residuals_and_moments

# Aligned images are compared on the coarsest layer, of the first three, with this shorter side: on a coarse one, noise and
# motion blur hardly matter.
_COMPARED, _COMPARED_PX = 2, 60


class Details(NamedTuple):
    """A layer without its local mean."""

    image: Image  # (H, W), the layer without its local mean; 0 at masked pixels
    weight: Image  # (H, W), that of the layer, 0 where the local mean is one-sided
    gain: float  # fraction of the variance of white noise that the blur leaves
    autocorrelation: FloatArray

    @property
    def contrast(self) -> float:
        """Mean square of the unmasked pixels relative to the variance of their noise."""
        seen = self.weight > 0
        return float(np.mean(np.square(self.image[seen]) * self.weight[seen])) / self.gain if seen.any() else 0.0


def similarity_under(homography: Homography, moving: Details, fixed: Details) -> Similarity:
    """Return the similarity of two images of one shape under a homography, from `moving` to `fixed`."""
    sums = np.empty(8)
    _sum_up(moving, fixed, homography, sums)
    pixels, first, second, squares, products, others, weight, other_weight = sums
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    covariance = np.array([[squares, products], [products, others]]) - np.outer([first, second], [first, second]) / pixels
    # Averaged over sub-pixel positions, linear interpolation leaves 4/9 of the variance of white noise.
    noise = moving.gain * pixels / weight, 4 / 9 * fixed.gain * pixels / other_weight
    autocorrelations = moving.autocorrelation, fixed.autocorrelation
    return similarity_of(covariance / max(1.0, pixels - 1), noise, pixels, pixels * min(1.0, moving.gain), autocorrelations)


@compiled
def _sum_up(moving: Details, fixed: Details, homography: Homography, sums: FloatArray) -> None:
    """Sum over the pixels that both see: ones, both images, their squares and products, and both weights."""
    height, width = moving.image.shape
    there, there_weight = np.empty(width, np.float32), np.empty(width, np.float32)
    sums[:] = 0
    for y in range(height):
        first, last = visible_columns(homography, y, 0.0, width - 1.0, 0.0, height - 1.0, width)
        x = first
        while x < last:
            run = run_from(homography, x, y, last - x, height, width)
            sample_run(fixed.image, run, there[x : x + run.size])
            sample_run(fixed.weight, run, there_weight[x : x + run.size])
            x += run.size
        here, here_weight = moving.image[y], moving.weight[y]
        for x in range(first, last):
            if here_weight[x] > 0 and there_weight[x] > 0:
                a, b = float(here[x]), float(there[x])
                sums[0] += 1
                sums[1] += a
                sums[2] += b
                sums[3] += a * a
                sums[4] += a * b
                sums[5] += b * b
                sums[6] += here_weight[x]
                sums[7] += there_weight[x]


class Pyramid(NamedTuple):
    """An exposure and its halves."""

    layers: tuple[Layer, ...]  # finest first
    details: Details  # those of the layer `compared`

    @property
    def compared(self) -> int:
        """Number of the layer on which aligned images are compared."""
        return _compared(self.layers)


def pyramid_of(exposure: VirtualExposure, levels: int, blur_px: float) -> Pyramid:
    """Return an exposure, blurred against photon noise, and its halves; small images have fewer than `levels` layers."""
    layers = tuple(_layer_of(view) for view in view_pyramid(exposure, blur_px, levels, SMALLEST_SIDE))
    layer = layers[_compared(layers)]
    seen = layer.weight > 0
    image = without_local_mean(layer.image, seen)
    # Near a border the mean is one-sided: a gradient looks like a structure there, in any two images.
    inside = cv2.erode(seen.astype(np.uint8), np.ones((LOCAL_PX, LOCAL_PX), np.uint8), borderValue=0) > 0
    if 2 * np.count_nonzero(inside) < np.count_nonzero(seen):
        inside = seen  # a small image has hardly anything else
    image = np.where(inside, image, np.float32(0))
    weight = np.where(inside, layer.weight, np.float32(0))
    return Pyramid(layers, Details(image, weight, 1 / (4 * np.pi * layer.blur_px**2), autocorrelation(image)))


def _compared(layers: Sequence[Layer]) -> int:
    """Return the number of the layer on which aligned images are compared."""
    return max((n for n, layer in enumerate(layers[: _COMPARED + 1]) if min(layer.image.shape) >= _COMPARED_PX), default=0)


def _layer_of(view: View) -> Layer:
    # A Gaussian of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
    blur_px = 1 / math.sqrt(4 * math.pi * view.noise_left)
    gradients = np.empty((2, *view.shape), np.float32)
    differentiate(np.ascontiguousarray(view.image), gradients)
    smoothed = np.empty_like(gradients)
    for axis in (0, 1):
        cv2.GaussianBlur(gradients[axis], (0, 0), blur_px, dst=smoothed[axis])
    return Layer(np.ascontiguousarray(view.image), np.ascontiguousarray(view.weight), blur_px, gradients, smoothed)


JUDGED = 1  # layer on which parts are compared: coarse, so that noise and small errors of the motion do not matter
_DIFFERENT = 0.5  # cap on the residual of a pixel in a search for shifts, relative to its usual one
# Side of the squares compared in a search for shifts, and spacing of the shifts that are tried.
_SEARCH_PX, _NEAR_PX = 5, 2
_LEAST_SEEN = 0.3  # minimum overlap under a shift, as a fraction of the template
_TRIED = 3  # number of shifts that a search returns


def part_following(moving: Layer, fixed: Layer, homography: Homography) -> Follows:
    """Find the part of a template that follows a motion, (3, 3), to pixels of another image of the same shape."""
    buffers = buffers_of(moving)
    residuals_and_moments(moving, fixed, homography, buffers, np.empty((3, 3)), np.empty((3, 3)))
    noise_left = 1 / (4 * np.pi * moving.blur_px**2)
    unknown = np.full_like(buffers.weight, np.inf)
    noise = np.divide(np.float32(noise_left), buffers.weight, out=unknown, where=buffers.weight > 0)
    return follows(moving.image, moving.image + buffers.residual, noise, noise_left)


def shifts_between(moving: Layer, fixed: Layer) -> list[Homography]:
    """Return the shifts under which most of a template fits an image, the best first: what moves otherwise counts half at most.

    All shifts by whole pixels, up to a third of the image, are compared.
    """
    height, width = moving.image.shape
    reach_y, reach_x = height // 3, width // 3
    seen, margins = (moving.weight > 0).astype(np.float32), ((reach_y, reach_y), (reach_x, reach_x))
    image, known = np.pad(fixed.image, margins), np.pad((fixed.weight > 0).astype(np.float32), margins)
    shifts = [(y, x) for y in range(-reach_y, reach_y + 1) for x in range(-reach_x, reach_x + 1)]
    squares = np.empty((len(shifts), height, width), np.float32)
    for index, (y, x) in enumerate(shifts):
        part = slice(reach_y + y, reach_y + y + height), slice(reach_x + x, reach_x + x + width)
        both = known[part] * seen
        near = _blur(both, _SEARCH_PX)
        difference = _blur(((image[part] - moving.image) * both) ** 2, _SEARCH_PX)
        squares[index] = np.where(near > 0.5, difference / np.maximum(near, np.float32(1e-6)), np.float32(np.nan))
    n_seen = np.isfinite(squares).sum(axis=(1, 2))
    # Each pixel counts relative to its usual difference, so that a part with strong contrast counts no more than others.
    ordered = np.sort(squares, axis=0)  # NaN comes last
    middle = np.isfinite(squares).sum(axis=0, keepdims=True) // 2
    usual = np.maximum(np.nan_to_num(np.take_along_axis(ordered, middle, axis=0)), np.float32(1e-12))
    relative = np.minimum(squares / usual, _DIFFERENT)
    cost = np.nansum(relative, axis=(1, 2)) / np.maximum(np.isfinite(relative).sum(axis=(1, 2)), 1)
    cost[n_seen < _LEAST_SEEN * height * width] = np.inf
    found: list[tuple[int, int]] = []
    for index in np.argsort(cost):
        y, x = shifts[index]
        if all(max(abs(y - other_y), abs(x - other_x)) >= _NEAR_PX for other_y, other_x in found):
            found.append((y, x))
        if len(found) == _TRIED:
            break
    return [translation(x, y) for y, x in found]


def masked(pyramid: Pyramid, part: BoolArray) -> Pyramid:
    """Return a pyramid of which only a part is used, given on any of its layers."""

    def limited(weight: Image) -> Image:
        size = weight.shape[1], weight.shape[0]
        return weight * cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    layers = tuple(layer._replace(weight=limited(layer.weight)) for layer in pyramid.layers)
    return pyramid._replace(layers=layers, details=pyramid.details._replace(weight=limited(pyramid.details.weight)))


def _blur(image: Image, side: int) -> Image:
    return np.asarray(cv2.blur(image, (side, side)), np.float32)
