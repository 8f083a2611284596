"""Locator `pycolmap-two-view`: COLMAP's features, matcher and LO-RANSAC for homographies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import normalised
from photonpano.locating import Matches, PointLocator, blur_against_noise, motion_from_points, stabilised_8_bit, too_few_matches
from photonpano_colmap.hooks import FIRST_CENTRE, SEEDS, PycolmapTwoViewConfig

MAX_TRIALS = 10_000  # of RANSAC, which finds a homography with 20 % inliers in half as many
_SIFT = pycolmap.FeatureExtractorType.SIFT


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Keypoints of one exposure, the largest first."""

    points: FloatArray  # (N, 2), pixel centres are integers
    sizes: FloatArray  # (N,), scales of the keypoints in px; position errors are proportional to them
    descriptors: NDArray[np.uint8]  # (N, 128)
    shape: tuple[int, int]  # (height, width) of the exposure

    def for_matcher(self) -> tuple[pycolmap.FeatureKeypoints, pycolmap.FeatureDescriptors]:
        """Return points and descriptors in types of the library, which cannot be pickled; matching uses positions alone."""
        keypoints = [pycolmap.FeatureKeypoint(x=x, y=y) for x, y in self.points.tolist()]
        return pycolmap.FeatureKeypoints(keypoints), pycolmap.FeatureDescriptors(_SIFT, self.descriptors)


class TwoViewLocator(PointLocator):
    """Extracts features once, matches them near the current motion or in the whole image, and fits all inliers.

    The library holds the GIL while it extracts and matches, so pairs are not processed in parallel; its own threads are off.
    """

    def __init__(self, config: PycolmapTwoViewConfig, seed: int) -> None:
        self._config: PycolmapTwoViewConfig = config
        self._seed = seed % SEEDS
        # It would log every extractor and matcher on stderr.
        pycolmap.logging.minloglevel = max(pycolmap.logging.minloglevel, int(pycolmap.logging.WARNING))

    def describe(self, exposure: VirtualExposure) -> Features:
        """Detect keypoints on the variance-stabilised image, and keep the largest outside of masked areas."""
        config = self._config
        blur_px = blur_against_noise(exposure, config.blur_px)
        image, mask = stabilised_8_bit(exposure, blur_px)
        options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
        options.sift.max_num_features = config.max_keypoints
        options.sift.peak_threshold = config.peak_threshold / max(1.0, blur_px)
        # A keypoint with two orientations would be matched twice.
        options.sift.max_num_orientations = 1
        # An extractor for each call: the library does not guarantee thread safety.
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        found, descriptors = extractor.extract_from_uint8_array(image)
        positions = np.array([(each.x, each.y, each.compute_scale()) for each in found], dtype=np.float64).reshape(-1, 3)
        positions[:, :2] -= FIRST_CENTRE
        x, y = (np.clip(np.rint(positions[:, axis]).astype(np.intp), 0, image.shape[1 - axis] - 1) for axis in (0, 1))
        # The library checks the limit after each scale, so there may be more.
        largest = np.argsort(-positions[:, 2], kind="stable")
        kept = largest[mask[y, x][largest] > 0][: config.max_keypoints]
        return Features(
            points=positions[kept, :2],
            sizes=positions[kept, 2],
            descriptors=np.asarray(descriptors.data, np.uint8)[kept],
            shape=(image.shape[0], image.shape[1]),
        )

    def _homography(self, moving: Features, fixed: Features, initial: Homography | None) -> Located | NotLocated:
        # The second attempt is for level 1, or where the current motion is wrong by more than the search radius.
        for matches in self._matches(moving, fixed, initial):
            motion = self._motion(moving, fixed, matches)
            if isinstance(motion, Located):
                break
        return motion

    def _matches(self, moving: Features, fixed: Features, initial: Homography | None) -> Iterator[Matches]:
        if initial is not None:
            yield _matches_of(moving, fixed, self._matched_nearby(moving, fixed, initial), guided=True)
        pairs = self._matcher().match(*moving.for_matcher(), *fixed.for_matcher())
        yield _matches_of(moving, fixed, np.asarray(pairs, np.intp).reshape(-1, 2), guided=False)

    def _matcher(self) -> pycolmap.FeatureMatcher:
        options = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        options.sift.max_ratio = self._config.ratio
        options.sift.cross_check = True
        # The approximate matcher is no faster for a few thousand keypoints.
        options.sift.cpu_brute_force_matcher = True
        return pycolmap.FeatureMatcher.create(options, pycolmap.Device.cpu)

    def _matched_nearby(self, moving: Features, fixed: Features, initial: Homography) -> NDArray[np.intp]:
        """Return the indices of matches near the positions that a motion predicts: (K, 2)."""
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.PLANAR
        geometry.H = initial
        # The required camera has no effect on a homography.
        height, width = moving.shape
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 1.0, width, height)
        first, second = ((*each.for_matcher(), camera) for each in (moving, fixed))
        self._matcher().match_guided(self._config.search_px, *first, *second, geometry)
        return np.asarray(geometry.inlier_matches, np.intp).reshape(-1, 2)

    def _motion(self, moving: Features, fixed: Features, matches: Matches) -> Located | NotLocated:
        """Find the homography that most matches agree on, and fit it to these."""
        config, here, there = self._config, matches.moving, matches.fixed
        counts = {"keypoints_moving": len(moving.points), "keypoints_fixed": len(fixed.points), "matches": len(here)}
        evidence = {name: float(count) for name, count in counts.items()}
        if len(here) < config.min_inliers:
            return too_few_matches(len(here), config, evidence)
        options = pycolmap.RANSACOptions(max_error=config.threshold_px, max_num_trials=MAX_TRIALS, random_seed=self._seed)
        consensus = pycolmap.estimate_homography_matrix(here, there, options)
        if consensus is None or not consensus["H"][2, 2]:
            return NotLocated(f"no motion agrees with any of {len(here)} matches", evidence)
        start = normalised(consensus["H"])
        return motion_from_points(here, there, start, moving.shape, config, sizes=matches.sizes, evidence=evidence)


def _matches_of(moving: Features, fixed: Features, pairs: NDArray[np.intp], guided: bool) -> Matches:
    return Matches(moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]], guided, moving.sizes[pairs[:, 0]])
