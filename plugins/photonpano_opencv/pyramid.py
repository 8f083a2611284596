"""Pyramids of exposures on the scale on which photon noise is uniform."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from photonpano_opencv.likeness import details_of
from photonpano_opencv.moments import differentiate

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import VirtualExposure
    from photonpano_opencv.likeness import Details

_SMALLEST_SIDE = 24
"""The pyramid ends before an image gets smaller than this, in px."""
JUDGE = 2
"""The layer on which images are compared in the end: coarse, so that noise is small and blur hardly counts."""
_BORDER = 3
"""Pixels this near to an edge, in units of the blur, are left out."""


class Layer(NamedTuple):
    """One level of a pyramid.

    Attributes:
        image: (H, W) float32, variance-stabilised and blurred.
        weight: (H, W) float32, inverse noise variance of a pixel before the blur; 0 where nothing was seen.
        blur_px: standard deviation of the Gaussian that leaves as much of white noise as the blur and the halving did, in px
            of the layer.
        gradients: (2, H, W) float32, the derivatives of the image along x and y.
        smoothed: (2, H, W) float32, the same, blurred once more as the noise was.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]
    blur_px: float
    gradients: NDArray[np.float32]
    smoothed: NDArray[np.float32]


class Pyramid(NamedTuple):
    """An exposure and its halves.

    Attributes:
        layers: finest first.
        details: of the layer of number `JUDGE`, or of the coarsest.
    """

    layers: tuple[Layer, ...]
    details: Details

    @property
    def judge(self) -> int:
        """The number of the layer that the details are of."""
        return min(JUDGE, len(self.layers) - 1)


def pyramid_of(exposure: VirtualExposure, levels: int, blur_px: float) -> Pyramid:
    """Return an exposure and its halves, finest first.

    Args:
        exposure: what is to be aligned.
        levels: how many layers at most; small images have fewer.
        blur_px: standard deviation of the Gaussian that quiets photon noise, in px of the exposure.
    """
    known = exposure.weight > 0
    stabilised = np.where(known, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(0))
    std = exposure.response.stabilised_std(np.where(known, exposure.weight, np.float32(1)))
    # Blurred alike everywhere: more weight for pixels that more frames saw would shift what lies between them.
    mask = known.astype(np.float32)
    image, variance, norm = (
        np.asarray(cv2.GaussianBlur(each, (0, 0), blur_px), np.float32) for each in (stabilised, mask * std * std, mask)
    )
    # Single pixels that are masked are bridged by their neighbours; near an edge the blur
    # is one-sided, and pulls by a few 0.01 px.
    bridged = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    border = math.ceil(_BORDER * blur_px)
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    seen = (cv2.erode(bridged, square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0) & (variance > 0)
    image /= np.where(norm > 0, norm, np.float32(1))
    weight = np.where(seen, norm / np.where(seen, variance, np.float32(1)), np.float32(0))
    layers = [layer_of(image, weight, _equivalent_blur_px(blur_px, 1))]
    while len(layers) < levels and min(layers[-1].image.shape) >= 2 * _SMALLEST_SIDE:
        layers.append(_halved(layers[-1], _equivalent_blur_px(blur_px, 2 ** len(layers))))
    return Pyramid(tuple(layers), details_of(layers[min(JUDGE, len(layers) - 1)]))


def layer_of(image: NDArray[np.float32], weight: NDArray[np.float32], blur_px: float) -> Layer:
    """Return a layer with its derivatives."""
    gradients = np.empty((2, *image.shape), np.float32)
    differentiate(np.ascontiguousarray(image), gradients)
    smoothed = np.empty_like(gradients)
    for axis in (0, 1):
        cv2.GaussianBlur(gradients[axis], (0, 0), blur_px, dst=smoothed[axis])
    return Layer(np.ascontiguousarray(image), np.ascontiguousarray(weight), blur_px, gradients, smoothed)


def _equivalent_blur_px(blur_px: float, factor: int) -> float:
    """Return the blur of a layer of pixels `factor` times as large, in px of the layer.

    A Gaussian of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
    """
    kernel = cv2.getGaussianKernel(2 * math.ceil(4 * blur_px) + 1, blur_px).ravel()
    averaged = np.convolve(kernel, np.full(factor, 1 / factor))
    left = factor**2 * float(np.sum(averaged**2)) ** 2
    return 1 / math.sqrt(4 * math.pi * left)


def _halved(layer: Layer, blur_px: float) -> Layer:
    """Average squares of four pixels; a square counts if all of it was seen."""
    height, width = (side // 2 * 2 for side in layer.image.shape)
    size = (width // 2, height // 2)
    image = np.asarray(cv2.resize(layer.image[:height, :width], size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    weight = cv2.resize(layer.weight[:height, :width], size, interpolation=cv2.INTER_AREA)
    whole = cv2.resize((layer.weight[:height, :width] > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return layer_of(image, np.where(whole == 1, 4 * weight, np.float32(0)), blur_px)
