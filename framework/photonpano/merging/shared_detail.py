"""Lower the photon noise of colours by the detail that they share."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano.values import FluxImage, Response

_RATIO_PX = 1.5  # standard deviation of the Gaussian over which the ratio of a colour to the sum of all is averaged
_WINDOW_PX = 1.5  # standard deviation of the Gaussian over which the detail of a colour's own is measured
_RELATIVE_STEP = 0.02  # relative step of numerical derivatives
_MANY_FRAMES = 1e4
_FEWEST_FRAMES = 1e-3


def with_shared_detail(flux: FluxImage, weight: FluxImage, response: Response) -> FluxImage:
    """Return the flux of each colour, with less noise where all colours have the same detail.

    What is expected of a colour is the brightness of the place, from the photons of all colours, times the ratio of the colour
    to the brightness around the place. The flux differs from that by photon noise of the variance v, and by detail of the
    colour's own of the variance e, which is measured around the place. The linear estimate with the least error is

        expected + e / (e + v) (flux - expected)                        (Wiener 1949)

    With many photons it is the flux itself.

    Args:
        flux: (H, W, C), finite.
        weight: (H, W, C), in frames.
        response: the camera's response, from which v follows.

    Returns:
        (H, W, C), not negative.
    """
    weight = np.maximum(weight, np.float32(_FEWEST_FRAMES))
    photons = flux * weight
    mean = _blurred(photons, _RATIO_PX) / _blurred(weight, _RATIO_PX)
    brightness = photons.sum(axis=-1) / np.maximum((weight * mean).sum(axis=-1), np.float32(1e-9))
    luminance = (brightness * mean.sum(axis=-1))[..., None]
    below = np.maximum(_blurred(weight * luminance, _RATIO_PX), np.float32(1e-9))
    expected = luminance * _blurred(photons, _RATIO_PX) / below
    noise = noise_of_a_frame(np.asarray(expected, np.float32), response) / weight
    certain = 1 / np.maximum(noise, np.float32(1e-12))
    difference = flux - expected
    own = _blurred(difference**2 * certain - 1, _WINDOW_PX) / _blurred(certain, _WINDOW_PX)
    own = np.maximum(own, 0)
    return np.asarray(np.maximum(expected + own / np.maximum(own + noise, np.float32(1e-12)) * difference, 0), np.float32)


def noise_of_a_frame(flux: FluxImage, response: Response) -> FluxImage:
    """Return the variance of flux estimated from many frames, times their number, from the scale on which it is uniform."""
    at = np.maximum(flux, np.float32(1e-4))
    low, high = (np.asarray(at * factor, np.float32) for factor in (1 - _RELATIVE_STEP, 1 + _RELATIVE_STEP))
    slope = np.asarray((response.stabilised(high, _MANY_FRAMES) - response.stabilised(low, _MANY_FRAMES)) / (high - low))
    std = response.stabilised_std(_MANY_FRAMES) / np.maximum(slope, np.float32(1e-9))
    return np.asarray(_MANY_FRAMES * std**2, np.float32)


def _blurred(image: FluxImage, std_px: float) -> FluxImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), std_px, borderType=cv2.BORDER_REFLECT), np.float32)
