"""SIFT features, matched and fitted: the off-the-shelf locator of the paper, with its accuracy got back by least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano import Located, NotLocated
from photonpano.geometry import apply, implausibility, normalised
from photonpano.locating import PointLimits, blur_against_noise, motion_from_points, stabilised_8_bit
from photonpano_opencv.matching import match_everywhere, match_nearby, unit_descriptors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import VirtualExposure
    from photonpano_opencv.configs import OpencvSiftConfig

GUIDED_RADII = (1.5, 1.0)
"""Once a motion is fitted, more matches are looked for near where it puts them; radii in units of `threshold_px`."""
GUIDED_RATIO = 0.9
"""Near the right place a match may be less distinct."""


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """Keypoints of one exposure.

    Attributes:
        points: (N, 2) float32, pixel centres are integers.
        sizes: (N,) float32, diameters of the keypoints in px; their positions err in proportion.
        descriptors: (N, 128) uint8: what OpenCV returns in float32 holds whole numbers only.
        shape: (height, width) of the exposure.
    """

    points: NDArray[np.float32]
    sizes: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    shape: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Pairs of keypoints, and what they agree on.

    Attributes:
        pairs: (K, 2) indices of moving and fixed keypoints.
        homography: (3, 3) the motion that most of them agree on; None if there is none beyond chance.
        agreeing: how many of them agree.
    """

    pairs: NDArray[np.intp]
    homography: NDArray[np.float64] | None
    agreeing: int


def least_agreeing(matches: int, guided: bool) -> float:
    """Return how many matches must agree to tell a motion from chance, in the form of Brown and Lowe (2007, section 3.2).

    Near where a motion is predicted, keypoints of pure noise match as well: 10 to 16 % of them agree on something, while 60 %
    and more do of a scene at 0.01 photons per pixel and frame. All over the image chance agrees on next to nothing, but of
    matches between exposures that are blurred, few agree to a pixel or two even when the motion is right.
    """
    return 8.0 + (0.3 if guided else 0.1) * matches


class SiftLocator:
    """Detects once, matches with the ratio test, finds a consensus, fits all inliers, and checks what came out."""

    def __init__(self, config: OpencvSiftConfig, seed: int) -> None:
        self._config = config
        self._seed = seed

    def describe(self, exposure: VirtualExposure) -> SiftFeatures:
        """Detect keypoints on the variance-stabilised image, where it was seen."""
        config = self._config
        blur_px = blur_against_noise(exposure) if config.blur_px == "auto" else config.blur_px
        image, mask = stabilised_8_bit(exposure, blur_px)
        threshold = config.contrast_threshold / max(1.0, blur_px)
        # A detector for each call: OpenCV does not promise that one may be shared by threads.
        sift = cv2.SIFT.create(config.max_keypoints, 3, threshold, enable_precise_upscale=True)
        keypoints, descriptors = sift.detectAndCompute(image, mask)
        # OpenCV keeps all keypoints that are as strong as the weakest, so there may be more than asked for.
        keypoints = keypoints[: config.max_keypoints]
        if descriptors is None:
            descriptors = np.zeros((0, 128))
        return SiftFeatures(
            points=np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32).reshape(-1, 2),
            sizes=np.array([keypoint.size for keypoint in keypoints], dtype=np.float32),
            descriptors=descriptors[: config.max_keypoints].astype(np.uint8),
            shape=exposure.flux.shape,
        )

    def register(self, moving: SiftFeatures, fixed: SiftFeatures, initial: NDArray[np.float64] | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when too few keypoints match or agree, when they leave the corners of the
            frame uncertain, or when no camera moves like that.
        """
        config = self._config
        evidence = {"keypoints_moving": float(len(moving.points)), "keypoints_fixed": float(len(fixed.points))}
        descriptors = unit_descriptors(moving.descriptors), unit_descriptors(fixed.descriptors)
        matches = Matches(np.zeros((0, 2), dtype=np.intp), None, 0)
        if initial is not None:
            predicted = apply(initial, moving.points)
            pairs = match_nearby(*descriptors, predicted, fixed.points, config.search_px, config.ratio)
            matches = self._consensus(moving.points, fixed.points, pairs, guided=True)
        if matches.homography is None:
            # No motion is known yet, or it is further off than the search reaches.
            pairs = match_everywhere(*descriptors, config.ratio)
            matches = self._consensus(moving.points, fixed.points, pairs, guided=False)
        pairs, homography = matches.pairs, matches.homography
        evidence["matches"] = float(len(pairs))
        if len(pairs) < config.min_inliers:
            return NotLocated(self._too_few("matches", evidence), evidence)
        evidence["agreeing"] = float(matches.agreeing)
        if homography is None:
            return NotLocated(
                f"{matches.agreeing} of {len(pairs)} matches agree on a motion, which may be chance "
                f"(more than {least_agreeing(len(pairs), guided=False):.0f} must)",
                evidence,
            )
        if reason := implausibility(homography, moving.shape):
            return NotLocated(f"{reason}, from {len(pairs)} matches", evidence)
        motion: Located | NotLocated
        for radius, max_std_px in zip(GUIDED_RADII, (np.inf, config.max_std_px), strict=True):
            limits = PointLimits(config.min_inliers, radius * config.threshold_px, max_std_px)
            predicted = apply(homography, moving.points)
            pairs = match_nearby(*descriptors, predicted, fixed.points, limits.threshold_px, GUIDED_RATIO)
            here, there, sizes = moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], moving.sizes[pairs[:, 0]]
            # Matches that were looked for within the threshold are inliers, all of them.
            motion = motion_from_points(here, there, homography, moving.shape, limits, sizes=sizes, evidence=evidence, rounds=1)
            if isinstance(motion, NotLocated):
                break
            homography = motion.homography
        return motion

    def _consensus(
        self, moving: NDArray[np.float32], fixed: NDArray[np.float32], pairs: NDArray[np.intp], guided: bool
    ) -> Matches:
        """Find the homography that most pairs agree on (MAGSAC++), unless chance alone could make them agree."""
        if len(pairs) < self._config.min_inliers:
            return Matches(pairs, None, 0)
        here, there = moving[pairs[:, 0]], fixed[pairs[:, 1]]
        settings = cv2.UsacParams()
        settings.threshold = self._config.threshold_px
        settings.confidence = 0.999
        settings.maxIterations = 5000
        settings.sampler = cv2.SAMPLING_UNIFORM
        settings.score = cv2.SCORE_METHOD_MAGSAC
        settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
        settings.randomGeneratorState = self._seed
        found, _ = cv2.findHomography(here, there, settings)
        # OpenCV returns nothing, or an empty matrix, when it finds no model.
        if np.shape(found) != (3, 3):
            return Matches(pairs, None, 0)
        homography = np.asarray(found, dtype=np.float64)
        distances = np.linalg.norm(apply(homography, here) - there, axis=1)
        # Exposures that are blurred or dark scatter more, and chance has less to choose from all over the image.
        tolerance_px = self._config.threshold_px * (1 if guided else 2)
        agreeing = int(np.count_nonzero(distances < tolerance_px))
        believed = agreeing > least_agreeing(len(pairs), guided)
        return Matches(pairs, normalised(homography) if believed else None, agreeing)

    def _too_few(self, what: str, evidence: dict[str, float]) -> str:
        return (
            f"{evidence[what]:.0f} {what}, fewer than min_inliers = {self._config.min_inliers} "
            f"({evidence['keypoints_moving']:.0f} and {evidence['keypoints_fixed']:.0f} keypoints)"
        )
