"""Images of exposures for alignment and keypoints: variance-stabilised, blurred against photon noise, masked."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.locating.configs import BlurPx
from photonpano.photometry import signal_to_noise
from photonpano.values import Homography, VirtualExposure

# Fraction of pixels clipped to black and to white, so that single hot pixels do not reduce the contrast of the rest.
_CLIPPED = 0.001
_BORDER = 3  # pixels nearer to a masked area than this, in units of the blur, are masked in a view
_ALL_SEEN = 0.999  # an interpolated pixel is unmasked if its neighbours are, up to rounding


@dataclass(frozen=True, eq=False)
class View:
    """An exposure as an image for alignment."""

    # (H, W) float32, on the scale on which photon noise is uniform, blurred; 0 inside of masked areas
    image: NDArray[np.float32]
    weight: NDArray[np.float32]  # (H, W) float32, inverse noise variance of a pixel before the blur; 0 at masked pixels
    blur_px: float  # standard deviation of the blur, in px of the exposure
    pixel: int = 1  # side of a pixel, in px of the exposure

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(H, W) bool, False at masked pixels."""
        return self.weight > 0

    @cached_property
    def noise_left(self) -> float:
        """Fraction of the noise variance 1 / weight that remains in a pixel after the blur."""
        averaged = np.full(self.pixel, 1 / self.pixel)
        if self.blur_px > 0:
            kernel = cv2.getGaussianKernel(2 * math.ceil(4 * self.blur_px) + 1, self.blur_px)
            averaged = np.convolve(kernel.ravel().astype(np.float64), averaged)
        return self.pixel**2 * float(np.sum(averaged**2)) ** 2

    def halved(self) -> View:
        """Average squares of four pixels; a square is masked if one of its pixels is."""
        height, width = (side // 2 * 2 for side in self.shape)
        size = (width // 2, height // 2)
        image, weight, whole = (
            np.asarray(cv2.resize(each[:height, :width], size, interpolation=cv2.INTER_AREA), np.float32)
            for each in (self.image, self.weight, self.seen.astype(np.float32))
        )
        return View(image, np.where(whole == 1, 4 * weight, np.float32(0)), self.blur_px, 2 * self.pixel)

    def seen_from(self, homography: Homography) -> View:
        """Return this image on the grid of another one, interpolated linearly.

        Args:
            homography: (3, 3), pixels of the other image to pixels of this one.
        """
        height, width = self.shape
        image, weight, whole = (
            np.asarray(
                cv2.warpPerspective(each, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP),
                np.float32,
            )
            for each in (self.image, self.weight, self.seen.astype(np.float32))
        )
        return View(image, np.where(whole > _ALL_SEEN, weight, np.float32(0)), self.blur_px, self.pixel)


def view_of(exposure: VirtualExposure, blur_px: float) -> View:
    """Return an exposure as an image for alignment.

    Single masked pixels are interpolated. Pixels nearer to a masked area or a border than three times the blur are masked: the
    blur is one-sided there, which biases the alignment.

    Args:
        exposure: flux and weight.
        blur_px: standard deviation of the Gaussian blur against photon noise, in px of the exposure.
    """
    known = exposure.weight > 0
    std = exposure.response.stabilised_std(np.where(known, exposure.weight, np.float32(1)))
    # A pixel at a smaller scale averages those of the frames that it covers.
    variance = np.where(known, std * std, np.float32(0)) * np.float32(min(1.0, exposure.scale) ** 2)
    image, noise, near = _blurred(_stabilised(exposure), variance, known.astype(np.float32), blur_px=blur_px)
    bridged = cv2.morphologyEx(known.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    border = math.ceil(_BORDER * blur_px)
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    seen = (cv2.erode(bridged, square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0) & (noise > 0)
    image = np.divide(image, near, out=np.zeros_like(image), where=near > 0)
    return View(image, np.divide(near, noise, out=np.zeros_like(near), where=seen), blur_px)


def view_pyramid(exposure: VirtualExposure, blur_px: float, levels: int, smallest_side: int) -> tuple[View, ...]:
    """Return the image pyramid of an exposure, finest first.

    Args:
        exposure: flux and weight.
        blur_px: standard deviation of the Gaussian blur against photon noise, in px of the exposure.
        levels: largest number of views.
        smallest_side: the pyramid ends before a side gets shorter than this, in px of a view.
    """
    views = [view_of(exposure, blur_px)]
    while len(views) < levels and min(views[-1].shape) >= 2 * smallest_side:
        views.append(views[-1].halved())
    return tuple(views)


def blur_against_noise(exposure: VirtualExposure, blur_px: BlurPx = "auto") -> float:
    """Return the standard deviation of the Gaussian blur against photon noise, in px: the value given, or that for `auto`.

    `auto` is 1 in the light, and up to 2.5 where noise exceeds the scene. In the light more blur costs accuracy (1.5 px instead
    of 1 px raised the error of a trajectory at flux 0.5 from 0.07 to 0.17 px), in the dark less blur does (at flux 0.02 most
    keypoints are noise then).
    """
    if blur_px != "auto":
        return blur_px
    return float(np.clip(2 / max(signal_to_noise(exposure), 1e-6), 1.0, 2.5))


def stabilised_8_bit(exposure: VirtualExposure, blur_px: float) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return an exposure on the scale on which its noise is uniform, blurred against noise, stretched to 8 bits.

    With uniform noise, keypoints are found in dark and bright parts alike; a linear or sRGB scale would favour one of them.

    Returns:
        The image, (H, W) uint8, and the mask of pixels that were seen, (H, W) uint8, 0 or 255.
    """
    known = exposure.weight > 0
    # Masked pixels have no weight; all others have the same, since weights by numbers of frames would shift structures.
    weighted, weight = _blurred(_stabilised(exposure), known.astype(np.float32), blur_px=blur_px)
    image = weighted / np.maximum(weight, 1e-6)
    mask = np.where(known, np.uint8(255), np.uint8(0))
    if not known.any():
        return np.zeros_like(mask), mask
    low, high = np.quantile(image[known], (_CLIPPED, 1 - _CLIPPED))
    stretched = (image - low) * (255 / max(high - low, 1e-6))
    return np.clip(np.rint(stretched), 0, 255).astype(np.uint8), mask


def _stabilised(exposure: VirtualExposure) -> NDArray[np.float32]:
    """Return the flux on the scale on which its noise is uniform, 0 at masked pixels."""
    stabilised = exposure.response.stabilised(exposure.flux, exposure.weight)
    return np.where(exposure.weight > 0, stabilised, np.float32(0))


def _blurred(*images: NDArray[np.float32], blur_px: float) -> tuple[NDArray[np.float32], ...]:
    """Return images blurred by a Gaussian of this standard deviation."""
    if blur_px == 0:
        return images
    return tuple(np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px), np.float32) for image in images)
