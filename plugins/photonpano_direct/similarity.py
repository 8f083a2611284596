"""Do two images show the same, once they are aligned? Compared is what stands out from its surroundings."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano.geometry import run_from, sample_run, visible_columns
from photonpano.photometry import Similarity, autocorrelation, similarity_of
from photonpano_direct.layers import Layer

_SURROUNDINGS_PX = 13
"""What counts as the surroundings of a pixel: a square of this side, in px of the layer."""


class Details(NamedTuple):
    """What stands out from its surroundings in a layer: shadows and slopes that fill an image look alike wherever one looks.

    Attributes:
        image: (H, W) float32, the layer minus the mean of the surroundings; 0 where nothing was seen.
        weight: (H, W) float32, that of the layer.
        gain: what the blur leaves of the variance of white noise.
        autocorrelation: that of the image.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]
    gain: float
    autocorrelation: FloatArray

    @property
    def contrast(self) -> float:
        """The mean square of what was seen over the variance of its noise."""
        seen = self.weight > 0
        return float(np.mean(np.square(self.image[seen]) * self.weight[seen])) / self.gain if seen.any() else 0.0


def details_of(layer: Layer) -> Details:
    """Return the details of a layer."""
    mask = (layer.weight > 0).astype(np.float32)
    norm = np.maximum(_surroundings(mask), np.float32(1e-6))
    image = np.asarray((layer.image - _surroundings(layer.image * mask) / norm) * mask, dtype=np.float32)
    return Details(image, layer.weight, 1 / (4 * np.pi * layer.blur_px**2), autocorrelation(image))


def agreement(moving: Details, fixed: Details, homography: NDArray[np.float64]) -> Similarity:
    """Return how alike two images are under a motion.

    Args:
        moving: one image.
        fixed: another of the same shape.
        homography: (3, 3), pixels of the moving image to pixels of the fixed one.
    """
    sums = np.empty(8)
    _sum_up(moving, fixed, homography, sums)
    pixels, first, second, squares, products, others, weight, other_weight = sums
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    covariance = np.array([[squares, products], [products, others]]) - np.outer([first, second], [first, second]) / pixels
    # Interpolation leaves 4/9 of the variance of white noise, on average over where between pixels it looks.
    noise = moving.gain * pixels / weight, 4 / 9 * fixed.gain * pixels / other_weight
    autocorrelations = moving.autocorrelation, fixed.autocorrelation
    return similarity_of(covariance / max(1.0, pixels - 1), noise, pixels, pixels * min(1.0, moving.gain), autocorrelations)


@compiled
def _sum_up(moving: Details, fixed: Details, homography: NDArray[np.float64], sums: NDArray[np.float64]) -> None:
    """Sum, over the pixels that both saw: ones, both images, their squares and products, and both weights."""
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


def _surroundings(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the square around each pixel."""
    return np.asarray(cv2.blur(image, (_SURROUNDINGS_PX, _SURROUNDINGS_PX)), dtype=np.float32)
