"""Alignment by the enhanced correlation coefficient (Evangelidis and Psarakis 2008), as OpenCV has it, coarse to fine."""

from __future__ import annotations

import re

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import normalised, rescaled, translation, why_implausible
from photonpano.locating import View, blur_against_noise, motion_from_images, view_pyramid
from photonpano_opencv.configs import OpencvEccConfig
from photonpano_opencv.phase import NOTHING_TO_HOLD, shift_between

_SMALLEST_SIDE = 32
"""The pyramid ends before an image gets smaller than this, in px."""
_PEAK_PX = 1.5
"""Standard deviation of the peak of the phase correlation that finds where to start."""


class EccLocator:
    """Climbs to the homography under which two exposures correlate most."""

    def __init__(self, config: OpencvEccConfig) -> None:
        self._config = config

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, _SMALLEST_SIDE)

    def register(
        self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: NDArray[np.float64] | None
    ) -> Located | NotLocated:
        """Align; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when OpenCV finds no way up at any level of the pyramid, or when the
            images do not look alike where it ends.
        """
        config, lost = self._config, ""
        homography = initial
        if homography is None:
            shift = shift_between(moving[-1], fixed[-1], _PEAK_PX)
            if shift is None:
                return NotLocated(NOTHING_TO_HOLD)
            homography = rescaled(translation(*shift), moving[-1].pixel)
        aligned = 0
        for here, there in zip(reversed(moving), reversed(fixed), strict=True):
            found = self._climbed(here, there, rescaled(homography, 1 / here.pixel))
            if isinstance(found, str):
                # A level that leads nowhere is passed over: the start may be good enough for the next, finer one.
                lost = found
                continue
            homography, aligned = rescaled(found, here.pixel), aligned + 1
        if not aligned:
            return NotLocated(lost)
        return motion_from_images(moving[0], fixed[0], homography, config, evidence={"aligned_levels": float(aligned)})

    def _climbed(self, moving: View, fixed: View, start: NDArray[np.float64]) -> NDArray[np.float64] | str:
        """Return the homography under which two images correlate most, from a start nearby, or why there is none."""
        config = self._config
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, config.max_iterations, config.converged)
        here, there = (np.where(view.seen, np.uint8(255), np.uint8(0)) for view in (moving, fixed))
        try:
            _, found = cv2.findTransformECCWithMask(
                moving.image, fixed.image, here, there, start.astype(np.float32), cv2.MOTION_HOMOGRAPHY, criteria, 1
            )
        except cv2.error as error:
            # What OpenCV does where it does not converge, in the midst of images that are right.
            return f"the correlation cannot be maximised: {_sentence_of(error)}"
        homography = np.asarray(found, np.float64)
        reason = why_implausible(homography, moving.shape, config.min_overlap)
        return f"the alignment diverges: {reason}" if reason else normalised(homography)


def _sentence_of(error: cv2.error) -> str:
    """Return what OpenCV says, without its own files and functions.

    From the text: the attributes of the exception belong to its class, and are those of whichever thread failed last.
    """
    found = re.search(r"error: \([^)]*\) (.*?)\.? in function", str(error))
    return found[1] if found else str(error)
