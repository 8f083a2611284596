"""Locator `phase-correlation`: shifts by phase correlation."""

from __future__ import annotations

import numpy as np

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import apply, normalised, translation
from photonpano.locating import NO_TEXTURE, TRANSLATION, View, blur_against_noise, motion_from_images, shift_between, view_of
from photonpano_opencv.configs import PhaseCorrelationConfig

# Fraction of the photons' information that phase correlation uses, as it weights noisy frequencies like those of the scene:
# squared errors are 8 to 17 times the bound of photon noise between 0.01 and 0.6 photons per pixel per frame.
_EFFICIENCY = 0.1


class PhaseCorrelationLocator:
    """Shifts one exposure onto another, starting from the shift of the image centre under the current motion.

    The other parameters of the current motion are dropped: no pair measures rolls and perspective, so their errors would be fed
    back from level to level.
    """

    def __init__(self, config: PhaseCorrelationConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> View:
        """Return the exposure on the scale on which photon noise is uniform."""
        return view_of(exposure, blur_against_noise(exposure, self._config.blur_px))

    def register(self, moving: View, fixed: View, initial: Homography | None) -> Located | NotLocated:
        """Shift; see `photonpano.Locator`.

        Returns:
            A translation; `NotLocated` with the numbers that decided when there is no texture, or when the images differ after
            alignment, as where the camera rolls.
        """
        config = self._config
        homography = np.eye(3) if initial is None else _shift_of(initial, moving.shape)
        for _ in range(config.max_rounds):
            shift = shift_between(moving, fixed.seen_from(homography), config.peak_px)
            if shift is None:
                return NotLocated(NO_TEXTURE)
            homography = normalised(homography @ translation(*shift))
            if max(abs(shift)) < config.converged_px:
                break
        return motion_from_images(moving, fixed, homography, config, free=TRANSLATION, efficiency=_EFFICIENCY)


def _shift_of(motion: Homography, shape: tuple[int, int]) -> FloatArray:
    """Return the translation that moves the centre of an image as a motion does."""
    centre = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
    return translation(*(apply(motion, centre) - centre)[0])
