"""Undo the blur of linear interpolation where photon noise allows it."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano import BoolArray, Response
from photonpano.merging import PhotonSum
from photonpano_core.dense_motion.field import Image
from photonpano_core.dense_motion.frames import count_variance
from photonpano_core.dense_motion.sub_exposures import blurred

_WINDOW_PX = 1.5  # standard deviation of the window over which the Laplacian is compared with its noise, in px


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
