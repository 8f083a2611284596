"""Locators by matches: `kornia-features`, SIFT keypoints matched by SMNN or AdaLAM, and `kornia-loftr`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from kornia.feature import SIFTFeatureScaleSpace, laf_is_filled, match_adalam, match_smnn
from kornia.geometry import RANSAC
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import transform_points
from photonpano.locating import (
    Matches,
    MatchingConfig,
    PointLocator,
    blur_against_noise,
    consensus_of,
    motion_from_points,
    stabilised_8_bit,
)
from photonpano_kornia.hooks import KorniaFeaturesConfig, KorniaLoftrConfig
from photonpano_kornia.runtime import device_of, image_on, loftr_from, one_thread, seeded

_FAR = 1e3  # descriptor distance of keypoints beyond the search radius; true ones are at most 2
_SMALLEST_SIDE = 32  # px: four of the cells that LoFTR matches first
_CONFIDENCE = 0.999  # probability of having found the best motion at which RANSAC stops


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """Keypoints of one exposure."""

    # (N, 2, 3), kornia's local affine frames: the last column is the position, the others the shape
    frames: NDArray[np.float32]
    descriptors: NDArray[np.float16]  # (N, 128), RootSIFT
    shape: tuple[int, int]  # (height, width) of the exposure

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
            frames, _, descriptors = sift(image_on(self._device, image) / 255, image_on(self._device, mask) > 0)
            # kornia pads its result with empty frames.
            filled = laf_is_filled(frames)[0]
            return SiftFeatures(
                frames[0, filled].cpu().numpy(), descriptors[0, filled].half().cpu().numpy(), (mask.shape[0], mask.shape[1])
            )

    def _homography(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Located | NotLocated:
        evidence = {"keypoints_moving": float(len(moving.frames)), "keypoints_fixed": float(len(fixed.frames))}
        with one_thread(), torch.inference_mode():
            return _motion_of(self._matches(moving, fixed, initial), moving.shape, self._config, self._seed, evidence)

    def _matches(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Iterator[Matches]:
        for guide in [initial, None] if initial is not None else [None]:
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
            near = cdist(transform_points(guide, moving.points), fixed.points) <= self._config.search_px
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


class Picture(NamedTuple):
    """An exposure as input of LoFTR. Its feature maps would take fifty times the memory."""

    image: NDArray[np.uint8]  # (H, W); masked pixels have the mean of the others
    seen: NDArray[np.bool_]  # (H, W), False for masked pixels


class LoftrLocator:
    """LoFTR, learned matching without keypoints (Sun et al. 2021), then a consensus, and a fit of all inliers."""

    def __init__(self, config: KorniaLoftrConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._device = device_of(config.device)
        self._network = loftr_from(
            config.weights,
            self._device,
            corrected_positions=config.corrected_positions,
            min_confidence=config.min_confidence,
        )

    def describe(self, exposure: VirtualExposure) -> Picture:
        """Return the exposure on the scale on which photon noise is uniform, in 8 bits."""
        image, mask = stabilised_8_bit(exposure, blur_against_noise(exposure, self._config.blur_px))
        seen = mask > 0
        if seen.any():
            image[~seen] = np.uint8(image[seen].mean())
        return Picture(image, seen)

    def register(self, moving: Picture, fixed: Picture, initial: Homography | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`."""
        if min(moving.image.shape) < _SMALLEST_SIDE:
            height, width = moving.image.shape
            return NotLocated(f"the images have {height}x{width} px, LoFTR needs at least {_SMALLEST_SIDE} along each side")
        if not (moving.seen.any() and fixed.seen.any()):
            return NotLocated("all pixels are masked")
        with one_thread(), torch.inference_mode():
            here, there = self._matched(moving, fixed)
            shape = (moving.image.shape[0], moving.image.shape[1])
            return _motion_of(self._attempts(here, there, initial), shape, self._config, self._seed, {})

    def _attempts(self, here: FloatArray, there: FloatArray, initial: Homography | None) -> Iterator[Matches]:
        """Yield the matches near the positions that the current motion predicts, then all."""
        if initial is not None:
            near = np.linalg.norm(transform_points(initial, here) - there, axis=1) <= self._config.search_px
            yield Matches(here[near], there[near], guided=True)
        yield Matches(here, there, guided=False)

    def _matched(self, moving: Picture, fixed: Picture) -> tuple[FloatArray, FloatArray]:
        """Return the matched points of both images, (N, 2) each, that are not masked in either."""
        images = (image_on(self._device, each.image) / 255 for each in (moving, fixed))
        answer = self._network(dict(zip(("image0", "image1"), images, strict=True)))
        # LoFTR has the centre of the first pixel at (0.5, 0.5).
        here, there = (answer[key].cpu().numpy().astype(np.float64) - 0.5 for key in ("keypoints0", "keypoints1"))
        counts = _seen_at(moving.seen, here) & _seen_at(fixed.seen, there)
        return here[counts], there[counts]


def _seen_at(seen: NDArray[np.bool_], points: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie on unmasked pixels: (N,) bool; a point outside of the image takes the nearest pixel."""
    columns, rows = (np.clip(np.rint(points[:, axis]).astype(int), 0, seen.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(seen[rows, columns])


def _motion_of(
    attempts: Iterable[Matches], shape: tuple[int, int], config: MatchingConfig, seed: int, evidence: Mapping[str, float]
) -> Located | NotLocated:
    """Return the motion of the first matches that agree by RANSAC, or why the last do not: see `consensus_of`."""

    def estimate(moving: NDArray[np.floating], fixed: NDArray[np.floating]) -> Homography:
        ransac = RANSAC("homography", inl_th=config.threshold_px, confidence=_CONFIDENCE, seed=seed)
        # On the CPU: these are a few small matrices.
        model, _ = ransac(torch.tensor(moving), torch.tensor(fixed))
        return np.asarray(model.numpy())

    consensus = consensus_of(attempts, estimate, config, evidence)
    if isinstance(consensus, NotLocated):
        return consensus
    matches, homography, found = consensus
    return motion_from_points(matches.moving, matches.fixed, homography, shape, config, sizes=matches.sizes, evidence=found)
