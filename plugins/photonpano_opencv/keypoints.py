"""From the keypoints of two exposures to a motion: matching, consensus, more matches where it points, least squares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import Located, NotLocated
from photonpano.geometry import apply, normalised, why_implausible
from photonpano.locating import KeypointConfig, least_agreeing, motion_from_points
from photonpano_opencv.matching import match_everywhere, match_nearby

GUIDED_RADII = (1.5, 1.0)
"""Once a motion is fitted, more matches are looked for near where it puts them; radii in units of `threshold_px`."""
GUIDED_RATIO = 0.9
"""Near the right place a match may be less distinct."""


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of one exposure.

    Attributes:
        points: (N, 2) float32, pixel centres are integers.
        sizes: (N,) float32, diameters of the keypoints in px; their positions err in proportion.
        descriptors: (N, D) uint8, as the detector gives them.
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


def detected(
    detector: cv2.Feature2D, image: NDArray[np.uint8], mask: NDArray[np.uint8], most: int
) -> tuple[Sequence[cv2.KeyPoint], Keypoints]:
    """Detect and describe the strongest keypoints of an image, where the mask is not 0.

    Returns:
        The keypoints as OpenCV has them, and as they are kept.
    """
    keypoints, descriptors = detector.detectAndCompute(image, mask)
    # OpenCV keeps all keypoints that are as strong as the weakest, so there may be more than asked for.
    keypoints = keypoints[:most]
    if descriptors is None:
        descriptors = np.zeros((0, 1))
    return keypoints, Keypoints(
        points=np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32).reshape(-1, 2),
        sizes=np.array([keypoint.size for keypoint in keypoints], dtype=np.float32),
        # What OpenCV returns in float32 for SIFT holds whole numbers only.
        descriptors=descriptors[:most].astype(np.uint8),
        shape=(image.shape[0], image.shape[1]),
    )


class KeypointMatcher:
    """Matches with the ratio test, finds a consensus, fits all inliers, and checks what came out."""

    def __init__(
        self,
        config: KeypointConfig,
        seed: int,
        as_unit_vectors: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
        ratio: float,
        rounding_px: float = 0.0,
    ) -> None:
        """Prepare to match.

        Args:
            config: thresholds.
            seed: of the consensus.
            as_unit_vectors: makes of descriptors what is compared by scalar products.
            ratio: of the distances of those vectors to the best and to the second best match.
            rounding_px: standard deviation of what all matches may err alike.
        """
        self._config = config
        self._seed = seed
        self._as_unit_vectors = as_unit_vectors
        self._ratio = ratio
        self._rounding_px = rounding_px

    def register(self, moving: Keypoints, fixed: Keypoints, initial: NDArray[np.float64] | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when too few keypoints match or agree, when they leave the corners of the
            frame uncertain, or when no camera moves like that.
        """
        config = self._config
        evidence = {"keypoints_moving": float(len(moving.points)), "keypoints_fixed": float(len(fixed.points))}
        descriptors = self._as_unit_vectors(moving.descriptors), self._as_unit_vectors(fixed.descriptors)
        matches = Matches(np.zeros((0, 2), dtype=np.intp), None, 0)
        if initial is not None:
            predicted = apply(initial, moving.points)
            pairs = match_nearby(*descriptors, predicted, fixed.points, config.search_px, self._ratio)
            matches = self._consensus(moving.points, fixed.points, pairs, guided=True)
        if matches.homography is None:
            # No motion is known yet, or it is further off than the search reaches.
            pairs = match_everywhere(*descriptors, self._ratio)
            matches = self._consensus(moving.points, fixed.points, pairs, guided=False)
        pairs, homography = matches.pairs, matches.homography
        evidence["matches"] = float(len(pairs))
        if len(pairs) < config.min_inliers:
            return NotLocated(
                f"{len(pairs)} matches, fewer than min_inliers = {config.min_inliers} "
                f"({len(moving.points)} and {len(fixed.points)} keypoints)",
                evidence,
            )
        evidence["agreeing"] = float(matches.agreeing)
        if homography is None:
            return NotLocated(
                f"{matches.agreeing} of {len(pairs)} matches agree on a motion, which may be chance "
                f"(more than {least_agreeing(len(pairs), guided=False):.0f} must)",
                evidence,
            )
        if reason := why_implausible(homography, moving.shape):
            return NotLocated(f"{reason}, from {len(pairs)} matches", evidence)
        motion: Located | NotLocated
        for radius, max_std_px in zip(GUIDED_RADII, (np.inf, config.max_std_px), strict=True):
            limits = config.model_copy(update={"threshold_px": radius * config.threshold_px, "max_std_px": max_std_px})
            predicted = apply(homography, moving.points)
            pairs = match_nearby(*descriptors, predicted, fixed.points, limits.threshold_px, GUIDED_RATIO)
            here, there, sizes = moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], moving.sizes[pairs[:, 0]]
            # Matches that were looked for within the threshold are inliers, all of them.
            motion = motion_from_points(
                here,
                there,
                homography,
                moving.shape,
                limits,
                sizes=sizes,
                evidence=evidence,
                rounds=1,
                rounding_px=self._rounding_px,
            )
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
