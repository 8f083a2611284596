"""Pyramids of exposures on the scale on which photon noise is uniform."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import VirtualExposure

_SMALLEST_SIDE = 24
"""The pyramid ends before an image gets smaller than this, in px."""
_BORDER = 3
"""Pixels this near to unseen ones, in units of the blur, are left out: theirs is one-sided, and pulls by a few 0.01 px."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """One level of a pyramid.

    Attributes:
        image: (H, W) float32, variance-stabilised and blurred.
        weight: (H, W) float32, inverse noise variance of a pixel before the blur; 0 where nothing was seen.
    """

    image: NDArray[np.float32]
    weight: NDArray[np.float32]


def pyramid_of(exposure: VirtualExposure, levels: int, blur_px: float) -> tuple[Layer, ...]:
    """Return an exposure and its halves, finest first.

    Args:
        exposure: what is to be aligned.
        levels: how many layers at most; small images have fewer.
        blur_px: standard deviation of the Gaussian that quiets photon noise, in px of the exposure.
    """
    known = exposure.weight > 0
    stabilised = np.where(known, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(0))
    variance = np.zeros(known.shape, dtype=np.float32)
    variance[known] = exposure.response.stabilised_std(exposure.weight[known]) ** 2
    # Blurred alike everywhere: more weight for pixels that more frames saw would shift what lies between them.
    image, variance = (cv2.GaussianBlur(each, (0, 0), blur_px) for each in (stabilised, variance))
    border = int(np.ceil(_BORDER * blur_px))
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    inside = cv2.erode(known.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    weight = np.divide(1, variance, out=np.zeros_like(variance), where=inside)
    layers = [Layer(np.asarray(image, dtype=np.float32), weight)]
    while len(layers) < levels and min(layers[-1].image.shape) >= 2 * _SMALLEST_SIDE:
        layers.append(_halved(layers[-1]))
    return tuple(layers)


def _halved(layer: Layer) -> Layer:
    """Average squares of four pixels; a square counts if all of it was seen."""
    height, width = (side // 2 * 2 for side in layer.image.shape)
    size = (width // 2, height // 2)
    image = np.asarray(cv2.resize(layer.image[:height, :width], size, interpolation=cv2.INTER_AREA), dtype=np.float32)
    weight = cv2.resize(layer.weight[:height, :width], size, interpolation=cv2.INTER_AREA)
    whole = cv2.resize((layer.weight[:height, :width] > 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return Layer(image, np.where(whole == 1, 4 * weight, np.float32(0)))
