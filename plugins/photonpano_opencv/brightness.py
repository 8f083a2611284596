"""Locators by brightness: `opencv-ecc`, coarse to fine, and `phase-correlation`, for shifts."""

from __future__ import annotations

import re

import cv2
import numpy as np

from photonpano import Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import normalised, rescaled, transform_points, translation, why_implausible
from photonpano.locating import (
    NO_TEXTURE,
    TRANSLATION,
    View,
    blur_against_noise,
    coarse_to_fine,
    motion_from_images,
    shift_between,
    view_of,
    view_pyramid,
)
from photonpano_opencv.hooks import OpencvEccConfig, PhaseCorrelationConfig

_SMALLEST_SIDE = 32  # minimum side of the images of the pyramid, px
# Fraction of the photons' information that phase correlation uses, as it weights noisy frequencies like those of the scene:
# squared errors are 8 to 17 times the bound of photon noise between 0.01 and 0.6 photons per pixel per frame.
_EFFICIENCY = 0.1


class EccLocator:
    """Maximises the enhanced correlation coefficient of two exposures (Evangelidis and Psarakis 2008), coarse to fine."""

    def __init__(self, config: OpencvEccConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, _SMALLEST_SIDE)

    def register(self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: Homography | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`."""
        if initial is None:
            shift = shift_between(moving[-1], fixed[-1])
            if shift is None:
                return NotLocated(NO_TEXTURE)
            initial = rescaled(translation(*shift), moving[-1].pixel)
        aligned, failure = coarse_to_fine(moving, fixed, initial, self._aligned)
        if failure is not None and not aligned:
            return failure
        evidence = {"aligned_levels": float(len(aligned))}
        return motion_from_images(moving[0], fixed[0], aligned[-1], self._config, evidence=evidence)

    def _aligned(self, moving: View, fixed: View, start: Homography, depth: int) -> Homography | NotLocated:
        """Return the homography near `start` under which two images correlate most."""
        del depth
        config = self._config
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, config.max_iterations, config.converged)
        here, there = (np.where(view.seen, np.uint8(255), np.uint8(0)) for view in (moving, fixed))
        try:
            _, found = cv2.findTransformECCWithMask(
                moving.image, fixed.image, here, there, start.astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria, 1
            )
        except cv2.error as error:
            # OpenCV also raises where the iteration does not converge on valid images. Its message is told without files and
            # functions, from its text: threads share the attributes of the error.
            sentence = re.search(r"error: \([^)]*\) (.*?)\.? in function", str(error))
            return NotLocated(f"the correlation cannot be maximised: {sentence[1] if sentence else error}")
        homography = np.asarray(found, np.float64)
        reason = why_implausible(homography, moving.shape, config.min_overlap)
        return NotLocated(f"the alignment diverges: {reason}") if reason else normalised(homography)


class PhaseCorrelationLocator:
    """Shifts one exposure onto another, starting from the shift of the image centre under the current motion.

    The rest of the current motion is dropped: no pair measures it, so that its errors would be fed back from level to level.
    """

    def __init__(self, config: PhaseCorrelationConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> View:
        """Return the exposure on the scale on which photon noise is uniform."""
        return view_of(exposure, blur_against_noise(exposure, self._config.blur_px))

    def register(self, moving: View, fixed: View, initial: Homography | None) -> Located | NotLocated:
        """Shift; see `photonpano.Locator`."""
        config = self._config
        homography: Homography = np.eye(3)
        if initial is not None:
            centre = np.array([[(moving.shape[1] - 1) / 2, (moving.shape[0] - 1) / 2]])
            homography = translation(*(transform_points(initial, centre) - centre)[0])
        for _ in range(config.max_rounds):
            shift = shift_between(moving, fixed.seen_from(homography), config.peak_px)
            if shift is None:
                return NotLocated(NO_TEXTURE)
            homography = normalised(homography @ translation(*shift))
            if max(abs(shift)) < config.converged_px:
                break
        return motion_from_images(moving, fixed, homography, config, free=TRANSLATION, efficiency=_EFFICIENCY)
