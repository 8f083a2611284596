"""Locator `kornia-loftr`: LoFTR, learned matching without keypoints (Sun et al. 2021)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from photonpano import FloatArray, Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import apply
from photonpano.locating import Matches, blur_against_noise, stabilised_8_bit
from photonpano_kornia.configs import KorniaLoftrConfig
from photonpano_kornia.consensus import motion_of
from photonpano_kornia.runtime import device_of, images_on, one_thread
from photonpano_kornia.weights import loftr_from

_SMALLEST_SIDE = 32  # px: four of the cells that LoFTR matches first


class Picture(NamedTuple):
    """An exposure as input of LoFTR. Its feature maps would take fifty times the memory.

    Attributes:
        image: (H, W) uint8; masked pixels have the mean of the others.
        seen: (H, W) bool, False for masked pixels.
    """

    image: NDArray[np.uint8]
    seen: NDArray[np.bool_]


class LoftrLocator:
    """Matches with the network, finds a consensus, and fits all inliers."""

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
        """Match and fit; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when too few points match or agree, when they leave the corners of the
            frame uncertain, or when no camera moves like that.
        """
        if min(moving.image.shape) < _SMALLEST_SIDE:
            height, width = moving.image.shape
            return NotLocated(f"the images have {height} x {width} px, LoFTR needs at least {_SMALLEST_SIDE} along each side")
        if not (moving.seen.any() and fixed.seen.any()):
            return NotLocated("all pixels are masked")
        with one_thread(), torch.inference_mode():
            here, there = self._matched(moving, fixed)
            shape = (moving.image.shape[0], moving.image.shape[1])
            return motion_of(self._attempts(here, there, initial), shape, self._config, self._seed, {})

    def _attempts(self, here: FloatArray, there: FloatArray, initial: Homography | None) -> Iterator[Matches]:
        """Return the matches near the positions that the current motion predicts, then all."""
        if initial is not None:
            near = np.linalg.norm(apply(initial, here) - there, axis=1) <= self._config.search_px
            yield Matches(here[near], there[near], guided=True)
        yield Matches(here, there, guided=False)

    def _matched(self, moving: Picture, fixed: Picture) -> tuple[FloatArray, FloatArray]:
        """Return the matched points of both images, (N, 2) each, that are not masked in either."""
        images = (images_on(self._device, each.image) / 255 for each in (moving, fixed))
        answer = self._network(dict(zip(("image0", "image1"), images, strict=True)))
        # LoFTR has the centre of the first pixel at (0.5, 0.5).
        here, there = (answer[key].cpu().numpy().astype(np.float64) - 0.5 for key in ("keypoints0", "keypoints1"))
        counts = _seen_at(moving.seen, here) & _seen_at(fixed.seen, there)
        return here[counts], there[counts]


def _seen_at(seen: NDArray[np.bool_], points: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie on unmasked pixels: (N,) bool; a point outside of the image takes the nearest pixel."""
    columns, rows = (np.clip(np.rint(points[:, axis]).astype(int), 0, seen.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(seen[rows, columns])
