"""Sums of frames: corrected and weighted, rescaled, blurred, and sharpened where the noise of their counts allows it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from photonpano import BoolArray, FrameSpan, Group, Response, Source, capture_of
from photonpano.merging import PhotonSum
from photonpano_core.mergers.dense_motion.field import Image

_MANY = 1e4  # frames for which the variance of a count is derived; it is then divided by them
_SHARE = np.float32(0.01)  # relative step of the numerical derivative
_WINDOW_PX = 1.5  # standard deviation of the window over which the Laplacian is compared with its noise, in px


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
