"""Image pyramids of exposures, on the scale on which photon noise is uniform."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np

from photonpano import VirtualExposure
from photonpano.locating import SMALLEST_SIDE, View, view_pyramid
from photonpano_direct.moments import Layer, differentiate
from photonpano_direct.similarity import Details, details_of

_COMPARED = 2  # layer on which aligned images are compared: coarse, so that noise and motion blur hardly matter


class Pyramid(NamedTuple):
    """An exposure and its halves."""

    layers: tuple[Layer, ...]  # finest first
    details: Details  # those of the layer `compared`

    @property
    def compared(self) -> int:
        """Number of the layer on which aligned images are compared."""
        return min(_COMPARED, len(self.layers) - 1)


def pyramid_of(exposure: VirtualExposure, levels: int, blur_px: float) -> Pyramid:
    """Return an exposure, blurred against photon noise, and its halves; small images have fewer than `levels` layers."""
    layers = tuple(_layer_of(view) for view in view_pyramid(exposure, blur_px, levels, SMALLEST_SIDE))
    return Pyramid(layers, details_of(layers[min(_COMPARED, len(layers) - 1)]))


def _layer_of(view: View) -> Layer:
    """Return a view with its derivatives."""
    # A Gaussian of standard deviation s leaves 1 / (4 pi s^2) of the variance of white noise.
    blur_px = 1 / math.sqrt(4 * math.pi * view.noise_left)
    gradients = np.empty((2, *view.shape), np.float32)
    differentiate(np.ascontiguousarray(view.image), gradients)
    smoothed = np.empty_like(gradients)
    for axis in (0, 1):
        cv2.GaussianBlur(gradients[axis], (0, 0), blur_px, dst=smoothed[axis])
    return Layer(np.ascontiguousarray(view.image), np.ascontiguousarray(view.weight), blur_px, gradients, smoothed)
