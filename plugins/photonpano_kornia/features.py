"""Locator `kornia-features`: kornia's SIFT keypoints, matched by SMNN or AdaLAM."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from kornia.feature import SIFTFeatureScaleSpace, laf_is_filled, match_adalam, match_smnn
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import apply
from photonpano.locating import Matches, PointLocator, blur_against_noise, stabilised_8_bit
from photonpano_kornia.configs import KorniaFeaturesConfig
from photonpano_kornia.consensus import motion_of
from photonpano_kornia.runtime import device_of, images_on, one_thread, seeded

_FAR = 1e3  # descriptor distance of keypoints beyond the search radius; true ones are at most 2


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """Keypoints of one exposure.

    Attributes:
        frames: (N, 2, 3) float32, kornia's local affine frames: the last column is the position, the others the shape.
        descriptors: (N, 128) float16, RootSIFT.
        shape: (height, width) of the exposure.
    """

    frames: NDArray[np.float32]
    descriptors: NDArray[np.float16]
    shape: tuple[int, int]

    @property
    def points(self) -> FloatArray:
        """(N, 2) positions; in kornia's features pixel centres are integers."""
        return self.frames[:, :, 2].astype(np.float64)

    @property
    def sizes(self) -> FloatArray:
        """(N,) diameters of the keypoints in px."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.frames[:, :, :2].astype(np.float64)))))


class FeatureLocator(PointLocator):
    """Detects keypoints once, matches them, finds a consensus, and fits all inliers."""

    def __init__(self, config: KorniaFeaturesConfig, seed: int) -> None:
        self._config: KorniaFeaturesConfig = config
        self._seed = seed
        self._device = device_of(config.device)

    def describe(self, exposure: VirtualExposure) -> SiftFeatures:
        """Detect keypoints on the variance-stabilised image, outside of masked areas."""
        config = self._config
        image, mask = stabilised_8_bit(exposure, blur_against_noise(exposure, config.blur_px))
        if not mask.any():
            return SiftFeatures(np.zeros((0, 2, 3), np.float32), np.zeros((0, 128), np.float16), mask.shape)
        with one_thread(), torch.inference_mode():
            # A detector for each call: kornia does not guarantee thread safety.
            sift = SIFTFeatureScaleSpace(
                config.max_keypoints, config.upright, device=self._device, descriptor_backend="pyramid"
            )
            frames, _, descriptors = sift(images_on(self._device, image) / 255, images_on(self._device, mask) > 0)
            # kornia pads its result with empty frames.
            filled = laf_is_filled(frames)[0]
            return SiftFeatures(
                frames[0, filled].cpu().numpy(), descriptors[0, filled].half().cpu().numpy(), (mask.shape[0], mask.shape[1])
            )

    def _homography(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Located | NotLocated:
        evidence = {"keypoints_moving": float(len(moving.frames)), "keypoints_fixed": float(len(fixed.frames))}
        with one_thread(), torch.inference_mode():
            return motion_of(self._matches(moving, fixed, initial), moving.shape, self._config, self._seed, evidence)

    def _matches(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Iterator[Matches]:
        for guide in [initial, None] if initial is not None else [None]:
            with one_thread(), torch.inference_mode():
                pairs = self._matched(moving, fixed, guide)
            here, there = moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]]
            yield Matches(here, there, guide is not None, moving.sizes[pairs[:, 0]])

    def _matched(self, moving: SiftFeatures, fixed: SiftFeatures, guide: Homography | None) -> NDArray[np.intp]:
        """Return the pairs of indices (K, 2) of keypoints that match."""
        if min(len(moving.frames), len(fixed.frames)) < 2:
            return np.zeros((0, 2), dtype=np.intp)
        here, there = (torch.tensor(each.descriptors, dtype=torch.float32, device=self._device) for each in (moving, fixed))
        distances = torch.cdist(here, there)
        near = None
        if guide is not None:
            near = cdist(apply(guide, moving.points), fixed.points) <= self._config.search_px
            distances.masked_fill_(torch.tensor(~near, device=self._device), _FAR)
        if self._config.matcher == "smnn":
            _, pairs = match_smnn(here, there, self._config.ratio, distances)
        else:
            frames = (torch.tensor(each.frames, device=self._device)[None] for each in (moving, fixed))
            # AdaLAM samples from the global generator.
            with seeded(self._seed, self._device):
                _, pairs = match_adalam(here, there, *frames, hw1=moving.shape, hw2=fixed.shape, dm=distances)
        found = np.asarray(pairs.cpu().numpy(), np.intp)
        return found if near is None else found[near[found[:, 0], found[:, 1]]]
