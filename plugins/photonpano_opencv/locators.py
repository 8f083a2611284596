"""Locators by OpenCV: of brightness, `opencv-ecc` and `phase-correlation`; of keypoints, `opencv-sift` and `opencv-orb`.

ECC aligns coarse to fine, phase correlation finds shifts. Keypoints are matched, MAGSAC finds the motion, more matches near the
motion are added, and least squares end it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import normalised, rescaled, transform_points, translation, why_implausible
from photonpano.locating import (
    NO_TEXTURE,
    TRANSLATION,
    KeypointConfig,
    Matches,
    PointLocator,
    View,
    blur_against_noise,
    coarse_to_fine,
    consensus_of,
    motion_from_images,
    motion_from_points,
    shift_between,
    stabilised_8_bit,
    view_of,
    view_pyramid,
)
from photonpano_opencv.hooks import OpencvEccConfig, OpencvOrbConfig, OpencvSiftConfig, PhaseCorrelationConfig

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


_GUIDED_RADII = (1.5, 1.0)  # of the search around predicted positions, one a round, in units of `threshold_px`
# Lowe's ratio within these radii
_GUIDED_RATIO = 0.9
# Standard deviation of rounding to whole pixels. Where a camera only shifts, all keypoints are rounded alike, so that the
# error does not decrease with the number of matches.
_ROUNDING_PX = math.sqrt(1 / 12)


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of one exposure."""

    points: NDArray[np.float32]  # (N, 2), pixel centres are integers
    sizes: NDArray[np.float32]  # (N,), diameters of the keypoints in px; position errors are proportional to them
    descriptors: NDArray[np.uint8]  # (N, D), as the detector returns them
    shape: tuple[int, int]  # (height, width) of the exposure


def detected(
    detector: cv2.Feature2D, image: NDArray[np.uint8], mask: NDArray[np.uint8], most: int
) -> tuple[Sequence[cv2.KeyPoint], Keypoints]:
    """Detect and describe at most `most` keypoints of an image, the strongest, where the mask is not 0."""
    keypoints, descriptors = detector.detectAndCompute(image, mask)
    # OpenCV keeps all keypoints that are as strong as the weakest, so there may be more than the detector's limit.
    keypoints = keypoints[:most]
    if descriptors is None:
        descriptors = np.zeros((0, 1))
    return keypoints, Keypoints(
        points=np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32).reshape(-1, 2),
        sizes=np.array([keypoint.size for keypoint in keypoints], dtype=np.float32),
        # OpenCV returns SIFT as float32, but in whole numbers.
        descriptors=descriptors[:most].astype(np.uint8),
        shape=(image.shape[0], image.shape[1]),
    )


class KeypointMatcher(PointLocator):
    """Matches keypoints with the ratio test, finds a consensus, and fits all inliers."""

    def __init__(
        self,
        config: KeypointConfig,
        seed: int,
        as_unit_vectors: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
        ratio: float,
        rounding_px: float = 0.0,
    ) -> None:
        """Take Lowe's ratio for distances of descriptors as unit vectors, and the standard error that all matches share."""
        self._config: KeypointConfig = config
        self._seed = seed
        self._as_unit_vectors = as_unit_vectors
        self._ratio = ratio
        self._rounding_px = rounding_px

    def _matches(self, moving: Keypoints, fixed: Keypoints, initial: Homography | None) -> Iterator[Matches]:
        descriptors = self._descriptors(moving, fixed)
        if initial is not None:
            predicted = transform_points(initial, moving.points)
            pairs = match_nearby(
                *descriptors, predicted, points=fixed.points, radius_px=self._config.search_px, ratio=self._ratio
            )
            yield Matches(moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], guided=True)
        pairs = match_everywhere(*descriptors, self._ratio)
        yield Matches(moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], guided=False)

    def _homography(self, moving: Keypoints, fixed: Keypoints, initial: Homography | None) -> Located | NotLocated:
        config = self._config
        evidence = {"keypoints_moving": float(len(moving.points)), "keypoints_fixed": float(len(fixed.points))}
        consensus = consensus_of(self._matches(moving, fixed, initial), self._estimate, config, evidence)
        if isinstance(consensus, NotLocated):
            return consensus
        matches, homography, evidence = consensus
        if reason := why_implausible(homography, moving.shape):
            return NotLocated(f"{reason}, from {len(matches.moving)} matches", evidence)
        motion: Located | NotLocated
        descriptors = self._descriptors(moving, fixed)
        for radius, max_std_px in zip(_GUIDED_RADII, (np.inf, config.max_std_px), strict=True):
            limits = config.model_copy(update={"threshold_px": radius * config.threshold_px, "max_std_px": max_std_px})
            predicted = transform_points(homography, moving.points)
            pairs = match_nearby(
                *descriptors, predicted, points=fixed.points, radius_px=limits.threshold_px, ratio=_GUIDED_RATIO
            )
            here, there, sizes = moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], moving.sizes[pairs[:, 0]]
            # One round: matches that were searched within the threshold are all inliers.
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

    def _descriptors(self, moving: Keypoints, fixed: Keypoints) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self._as_unit_vectors(moving.descriptors), self._as_unit_vectors(fixed.descriptors)

    def _estimate(self, moving: NDArray[np.floating], fixed: NDArray[np.floating]) -> Homography | None:
        """Return the homography that most matches agree on (MAGSAC++)."""
        settings = cv2.UsacParams()
        settings.threshold = self._config.threshold_px
        settings.confidence = 0.999
        settings.maxIterations = 5000
        settings.sampler = cv2.SAMPLING_UNIFORM
        settings.score = cv2.SCORE_METHOD_MAGSAC
        settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
        settings.randomGeneratorState = self._seed
        found, _ = cv2.findHomography(moving, fixed, settings)
        # Without a model OpenCV returns None, or an empty matrix.
        return np.asarray(found, np.float64) if np.shape(found) == (3, 3) else None


class SiftLocator(KeypointMatcher):
    """SIFT features, the off-the-shelf locator of the paper, with a least-squares fit of all inliers."""

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


class OrbLocator(KeypointMatcher):
    """ORB features, the fastest of the classical ones and the least accurate."""

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


def unit_descriptors(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return RootSIFT (Arandjelovic and Zisserman 2012): square roots, so that the scalar product is Hellinger's kernel."""
    raw = descriptors.astype(np.float32)
    return np.asarray(np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1)))


def unit_bits(descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the bits of (N, D) bytes as vectors of length 1: the square of a distance is 4 / (8 D) times Hamming's."""
    bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
    return np.asarray((2 * bits - 1) / np.sqrt(max(1, bits.shape[1])), np.float32)


def match_everywhere(moving: NDArray[np.float32], fixed: NDArray[np.float32], ratio: float) -> NDArray[np.intp]:
    """Match unit descriptors (M, D) and (N, D): pairs of indices (K, 2)."""
    if min(len(moving), len(fixed)) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    similarity = moving @ fixed.T
    rows = np.arange(len(moving))
    best = similarity.argmax(axis=1)
    mutual = similarity.argmax(axis=0)[best] == rows
    first = similarity[rows, best]
    similarity[rows, best] = -1
    second = similarity.max(axis=1)
    # Unit vectors: the squared distance is 2 - 2 * similarity, and Lowe's ratio is one of distances.
    distinct = (1 - first) <= ratio**2 * (1 - second)
    chosen = np.flatnonzero(mutual & distinct)
    return np.stack([chosen, best[chosen]], axis=1)


def match_nearby(
    moving: NDArray[np.float32],
    fixed: NDArray[np.float32],
    predicted: FloatArray,
    *,
    points: NDArray[np.float32],
    radius_px: float,
    ratio: float,
) -> NDArray[np.intp]:
    """Match unit descriptors (M, D) and (N, D) within a radius of predicted positions: pairs of indices (K, 2).

    `predicted` are positions of the moving keypoints in the fixed image, `points` those of the fixed ones, px. Without a second
    candidate, its similarity is taken as -1.
    """
    if min(len(moving), len(fixed)) == 0:
        return np.zeros((0, 2), dtype=np.intp)
    near = cKDTree(predicted).sparse_distance_matrix(cKDTree(points), radius_px, output_type="ndarray")
    i, j = near["i"], near["j"]
    similarity = np.einsum("kd,kd->k", moving[i], fixed[j])
    first, best = _best_two(i, similarity, len(moving))
    partner, _ = _best_two(j, similarity, len(fixed))
    k = first[first >= 0]
    second = best[i[k], 1]
    mutual = partner[j[k]] == k
    distinct = (1 - similarity[k]) <= ratio**2 * (1 - second)
    k = k[mutual & distinct]
    return np.stack([i[k], j[k]], axis=1)


def _best_two(
    owner: NDArray[np.intp], similarity: NDArray[np.float32], count: int
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the index of the best candidate of each owner (-1 if none), and the similarities of the best and second best."""
    order = np.lexsort((-similarity, owner))
    starts = np.flatnonzero(np.diff(owner[order], prepend=-1))
    best = np.full(count, -1, dtype=np.intp)
    best[owner[order[starts]]] = order[starts]
    values = np.full((count, 2), -1, dtype=np.float32)
    values[owner[order[starts]], 0] = similarity[order[starts]]
    seconds = starts[np.diff(np.append(starts, len(order))) > 1] + 1
    values[owner[order[seconds]], 1] = similarity[order[seconds]]
    return best, values
