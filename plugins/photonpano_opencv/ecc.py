"""Locator `opencv-ecc`: OpenCV's enhanced correlation coefficient (Evangelidis and Psarakis 2008), coarse to fine."""

from __future__ import annotations

import re

import cv2
import numpy as np

from photonpano import Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import normalised, rescaled, translation, why_implausible
from photonpano.locating import (
    NO_TEXTURE,
    View,
    blur_against_noise,
    coarse_to_fine,
    motion_from_images,
    shift_between,
    view_pyramid,
)
from photonpano_opencv.configs import OpencvEccConfig

_SMALLEST_SIDE = 32  # minimum side of the images of the pyramid, px


class EccLocator:
    """Finds the homography under which two exposures correlate most."""

    def __init__(self, config: OpencvEccConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, _SMALLEST_SIDE)

    def register(self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: Homography | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when OpenCV converges on no layer of the pyramid, or when the images
            differ after alignment.
        """
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
            # OpenCV also raises where the iteration does not converge on valid images.
            return NotLocated(f"the correlation cannot be maximised: {_sentence_of(error)}")
        homography = np.asarray(found, np.float64)
        reason = why_implausible(homography, moving.shape, config.min_overlap)
        return NotLocated(f"the alignment diverges: {reason}") if reason else normalised(homography)


def _sentence_of(error: cv2.error) -> str:
    """Return OpenCV's message without the names of its files and functions.

    It is taken from the text: attributes of `cv2.error` are shared by all threads.
    """
    found = re.search(r"error: \([^)]*\) (.*?)\.? in function", str(error))
    return found[1] if found else str(error)
