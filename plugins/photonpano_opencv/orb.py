"""Locator `opencv-orb`: ORB features, the fastest of the classical ones and the least accurate."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from photonpano import VirtualExposure
from photonpano.locating import blur_against_noise, stabilised_8_bit
from photonpano_opencv.configs import OpencvOrbConfig
from photonpano_opencv.keypoints import KeypointMatcher, Keypoints, detected
from photonpano_opencv.matching import unit_bits

# Standard deviation of rounding to whole pixels. Where a camera only shifts, all keypoints are rounded alike, so that the
# error does not decrease with the number of matches.
_ROUNDING_PX = math.sqrt(1 / 12)


class OrbLocator(KeypointMatcher):
    """Detects ORB keypoints once, and matches and fits them."""

    def __init__(self, config: OpencvOrbConfig, seed: int) -> None:
        # The Hamming distance is proportional to the squared distance of the unit vectors.
        super().__init__(config, seed, unit_bits, math.sqrt(config.ratio), _ROUNDING_PX)
        self._orb = config

    def describe(self, exposure: VirtualExposure) -> Keypoints:
        """Detect keypoints on the variance-stabilised image, outside of masked areas."""
        config = self._orb
        blur_px = blur_against_noise(exposure, config.blur_px)
        # A detector for each call: OpenCV does not guarantee thread safety.
        orb = cv2.ORB.create(
            config.max_keypoints, config.pyramid_scale, config.pyramid_levels, fastThreshold=config.fast_threshold
        )
        image, mask = stabilised_8_bit(exposure, blur_px)
        found, keypoints = detected(orb, image, mask, config.max_keypoints)
        # OpenCV multiplies positions in a coarse level by its nominal scale, as if the centre of pixel (0, 0) were its corner.
        scales = np.array([config.pyramid_scale**keypoint.octave for keypoint in found], dtype=np.float32).reshape(-1, 1)
        size = np.array(image.shape[::-1], dtype=np.float32)
        centres = (keypoints.points / scales + 0.5) * (size / np.rint(size / scales)) - 0.5
        return replace(keypoints, points=np.asarray(centres, np.float32))
