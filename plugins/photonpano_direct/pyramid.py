"""Image pyramids of exposures, on the scale on which photon noise is uniform, and the similarity of two under a motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from photonpano import FloatArray, Homography, VirtualExposure
from photonpano.compiling import compiled
from photonpano.geometry import run_from, sample_run, visible_columns
from photonpano.locating import SMALLEST_SIDE, View, view_pyramid
from photonpano.photometry import LOCAL_PX, Similarity, autocorrelation, similarity_of, without_local_mean
from photonpano_direct.moments import Image, Layer, differentiate

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
