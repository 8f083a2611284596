"""Locator `opencv-sift`: SIFT features, the off-the-shelf locator of the paper, with a least-squares fit of all inliers."""

from __future__ import annotations

import cv2

from photonpano import VirtualExposure
from photonpano.locating import blur_against_noise, stabilised_8_bit
from photonpano_opencv.configs import OpencvSiftConfig
from photonpano_opencv.keypoints import KeypointMatcher, Keypoints, detected
from photonpano_opencv.matching import unit_descriptors


class SiftLocator(KeypointMatcher):
    """Detects SIFT keypoints once, and matches and fits them."""

    def __init__(self, config: OpencvSiftConfig, seed: int) -> None:
        super().__init__(config, seed, unit_descriptors, config.ratio)
        self._sift = config

    def describe(self, exposure: VirtualExposure) -> Keypoints:
        """Detect keypoints on the variance-stabilised image, outside of masked areas."""
        config = self._sift
        blur_px = blur_against_noise(exposure, config.blur_px)
        threshold = config.contrast_threshold / max(1.0, blur_px)
        # A detector for each call: OpenCV does not guarantee thread safety.
        sift = cv2.SIFT.create(config.max_keypoints, 3, threshold, enable_precise_upscale=True)
        return detected(sift, *stabilised_8_bit(exposure, blur_px), config.max_keypoints)[1]
