"""From matches to a motion: kornia's RANSAC, then least squares."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from kornia.geometry import RANSAC
from numpy.typing import NDArray

from photonpano import Homography, Located, NotLocated
from photonpano.locating import Matches, MatchingConfig, consensus_of, motion_from_points

_CONFIDENCE = 0.999  # probability of having found the best motion at which RANSAC stops


def motion_of(
    attempts: Iterable[Matches], shape: tuple[int, int], config: MatchingConfig, seed: int, evidence: Mapping[str, float]
) -> Located | NotLocated:
    """Return the motion of the first matches that agree on one beyond chance; if none do, why the last ones do not.

    Args:
        attempts: at least one set of matches; a later one is computed only if those before it fail.
        shape: (height, width) of both images.
        config: thresholds of acceptance.
        seed: of RANSAC.
        evidence: counts of the backend, for the record.
    """

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
