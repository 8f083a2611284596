"""Phase correlation (Kuglin and Hines 1975): the shift between two images from the phases of their spectra."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import apply, normalised, translation
from photonpano.locating import View, blur_against_noise, motion_from_images, view_of
from photonpano_opencv.configs import PhaseCorrelationConfig

TRANSLATION = (4, 5)
"""Which of p1..p8 shift."""
NOTHING_TO_HOLD = "where the images overlap, if they do, there is no texture"
"""Why there is no shift to be told."""
_EFFICIENCY = 0.1
"""Frequencies count alike, also those that hold little but noise: squared errors of shifts are so much larger than photons
would allow, 8 to 17 times between 0.01 and 0.6 photons per pixel per frame."""
_TAPER = 0.25
"""The window falls to nothing within this share of the shorter side, towards what was not seen."""


class PhaseCorrelationLocator:
    """Shifts one exposure onto another, from where the motion known so far puts its middle.

    No more of that motion is taken over: what no pair measures, rolls and perspective, would be fed back from level to level.
    """

    def __init__(self, config: PhaseCorrelationConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> View:
        """Return the exposure on the scale on which photon noise is uniform."""
        return view_of(exposure, blur_against_noise(exposure, self._config.blur_px))

    def register(self, moving: View, fixed: View, initial: NDArray[np.float64] | None) -> Located | NotLocated:
        """Shift; see `photonpano.Locator`.

        Returns:
            A translation; `NotLocated` with the numbers that decided when nothing stands out, or when the images do not look
            alike after it, as where the camera rolls.
        """
        config = self._config
        homography = np.eye(3) if initial is None else _shift_of(initial, moving.shape)
        for _ in range(config.max_rounds):
            shift = shift_between(moving, fixed.seen_from(homography), config.peak_px)
            if shift is None:
                return NotLocated(NOTHING_TO_HOLD)
            homography = normalised(homography @ translation(*shift))
            if max(abs(shift)) < config.converged_px:
                break
        return motion_from_images(moving, fixed, homography, config, free=TRANSLATION, efficiency=_EFFICIENCY)


def _shift_of(motion: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the translation that takes the middle of an image where a motion takes it."""
    middle = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
    return translation(*(apply(motion, middle) - middle)[0])


def shift_between(moving: View, there: View, peak_px: float) -> NDArray[np.float64] | None:
    """Return the shift (x, y) in px that takes one image to another on the same grid; None if there is nothing to tell it.

    The cross-power spectrum, with all amplitudes made equal, is that of a peak at the shift. All frequencies count alike in it,
    also those that hold noise only; so it is blurred, which makes the peak a Gaussian whose place three values tell.

    Args:
        moving: one image.
        there: the other one.
        peak_px: standard deviation of the peak.
    """
    both = moving.seen & there.seen
    if not both.any():
        return None
    # Each image in a window that falls to nothing at borders: else the borders, which do not move, would be what correlates.
    window = _window(both)
    spectra = [fft.rfft2(window * (view.image - view.image[both].mean())) for view in (moving, there)]
    cross = spectra[1] * spectra[0].conj()
    amplitude = np.abs(cross)
    if not amplitude.max() > 0:
        return None
    height, width = both.shape
    down, across = np.meshgrid(fft.fftfreq(height), fft.rfftfreq(width), indexing="ij")
    gaussian = np.exp(-2 * (np.pi * peak_px) ** 2 * (down**2 + across**2))
    surface = fft.irfft2(gaussian * cross / np.maximum(amplitude, 1e-12 * amplitude.max()), s=both.shape)
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    y = row + _summit(surface[[row - 1, row, (row + 1) % height], column])
    x = column + _summit(surface[row, [column - 1, column, (column + 1) % width]])
    # Shifts beyond half of the image come out as negative ones.
    return np.array([(x + width / 2) % width - width / 2, (y + height / 2) % height - height / 2])


def _window(seen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return 1 inside of what was seen, falling to 0 at its borders."""
    distance = cv2.distanceTransform(np.pad(seen, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    within = np.minimum(distance / (_TAPER * min(seen.shape)), 1)
    return np.asarray(np.sin(np.pi / 2 * within) ** 2, np.float32)


def _summit(values: NDArray[np.float64]) -> float:
    """Return where a Gaussian through three values is highest, from the middle one, which is the largest of them."""
    before, here, after = np.log(np.maximum(values, 1e-3 * values[1]))
    curvature = before - 2 * here + after
    return float((before - after) / (2 * curvature)) if curvature < 0 else 0.0
