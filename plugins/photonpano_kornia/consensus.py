"""From matches to a motion: kornia's RANSAC, and the least squares that all locators end with."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from kornia.geometry import RANSAC
from numpy.typing import NDArray

from photonpano import Located, NotLocated
from photonpano.geometry import apply, normalised
from photonpano.locating import MatchingConfig, least_agreeing, motion_from_points

_CONFIDENCE = 0.999
"""RANSAC stops when it has found the best motion with this probability."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Points of two images that are thought to be the same.

    Attributes:
        moving: (N, 2) points of the moving image; pixel centres are integers.
        fixed: (N, 2) their partners.
        guided: whether they were looked for near where a motion puts them.
        sizes: (N,) diameters of the keypoints, where they differ.
    """

    moving: NDArray[np.float64]
    fixed: NDArray[np.float64]
    guided: bool
    sizes: NDArray[np.float64] | None = None


def motion_of(
    tries: Iterable[Matches], shape: tuple[int, int], config: MatchingConfig, seed: int, evidence: Mapping[str, float]
) -> Located | NotLocated:
    """Return the motion of the first matches that agree on one beyond chance; if none do, why the last ones do not.

    Args:
        tries: matches, at least once; later ones are not asked for where earlier ones will do.
        shape: (height, width) of both images.
        config: what it takes to be believed.
        seed: of RANSAC.
        evidence: what was counted before, for the record.
    """
    for matches in tries:
        count = len(matches.moving)
        found = {**evidence, "matches": float(count)}
        if count < config.min_inliers:
            reason = f"{count} matches, fewer than min_inliers = {config.min_inliers}"
            continue
        homography, agreeing = _consensus(matches, config.threshold_px, seed)
        found["agreeing"] = float(agreeing)
        least = least_agreeing(count, matches.guided)
        if homography is None or agreeing <= least:
            reason = f"{agreeing} of {count} matches agree on a motion, which may be chance (more than {least:.0f} must)"
            continue
        return motion_from_points(matches.moving, matches.fixed, homography, shape, config, sizes=matches.sizes, evidence=found)
    return NotLocated(reason, found)


def _consensus(matches: Matches, threshold_px: float, seed: int) -> tuple[NDArray[np.float64] | None, int]:
    """Return the homography that most matches agree on, None if there is none, and how many do."""
    ransac = RANSAC("homography", inl_th=threshold_px, confidence=_CONFIDENCE, seed=seed)
    # On the CPU: these are a few small matrices.
    model, _ = ransac(torch.tensor(matches.moving), torch.tensor(matches.fixed))
    if not model[2, 2]:
        return None, 0
    homography = normalised(model.numpy())
    distances = np.linalg.norm(apply(homography, matches.moving) - matches.fixed, axis=1)
    # Exposures that are blurred or dark scatter more, and chance has less to choose from all over the image.
    tolerance_px = threshold_px * (1 if matches.guided else 2)
    return homography, int(np.count_nonzero(distances < tolerance_px))
