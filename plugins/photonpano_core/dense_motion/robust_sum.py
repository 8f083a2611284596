"""Add sub-exposures up with weights that leave out what contradicts the reference sub-exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray
from photonpano.merging import PhotonSum
from photonpano_core.dense_motion.field import MotionField
from photonpano_core.dense_motion.sub_exposures import Image, SubExposures, blurred

_DETAIL_PX, _WINDOW_PX = 0.9, 1.2
"""Blur of sub-exposures, and the window over which their differences are averaged, in px of a frame."""
_TOLERATED = 1.5
"""Squared difference, in units of the photon noise, that costs no weight."""
_EXPLAINED = 0.8
"""Share of the frames that must agree, or other motions are tried."""
_MOVES_PX = 1.0
"""Motion within a group that a neighbour takes over, in px of a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class RobustSum:
    """Weighted sum of sub-exposures.

    Attributes:
        photons: counts and weights.
        explained: (H, W) float32, share of the frames of a pixel that are in the sum.
    """

    photons: PhotonSum
    explained: Image

    def improved(self, other: RobustSum, where: BoolArray) -> RobustSum:
        """Return the sum that takes, within `where`, each pixel from the one that explains more frames."""
        better = where & (other.explained > self.explained)
        return RobustSum(
            PhotonSum(
                np.where(better, other.photons.counts, self.photons.counts),
                np.where(better, other.photons.weight, self.photons.weight),
            ),
            np.where(better, other.explained, self.explained),
        )


def best_sum(parts: SubExposures, field: MotionField, where: BoolArray, tolerance_px: float) -> PhotonSum:
    """Merge a group along whichever motion explains the most frames of each pixel.

    A field is smooth, but the motion jumps at the border of an object. Where the field explains too few frames, a pixel may
    move as its nearest neighbour that moves and is explained, or not at all beyond the global motion.

    Args:
        parts: the sub-exposures, along the global motion.
        field: the motion beyond it.
        where: (H, W) pixels that may move; elsewhere all frames count.
        tolerance_px: motion within which frames are summed before they are warped, in px of a frame.
    """
    sums = parts.along(field, where, tolerance_px)
    best = _robust_sum(parts, sums, where)
    poor = where & (best.explained < _EXPLAINED)
    movers = where & ~poor & (field.way_px > _MOVES_PX * parts.scale)
    if poor.any() and movers.any():
        again = parts.along(field.filled(movers), poor, 2 * tolerance_px)
        mixed = [_replaced(each, other, poor) for each, other in zip(sums, again, strict=True)]
        best = best.improved(_robust_sum(parts, mixed, where), poor)
    return best.improved(_robust_sum(parts, parts.sums, where), where).photons


def _robust_sum(parts: SubExposures, sums: Sequence[PhotonSum], where: BoolArray) -> RobustSum:
    """Weight sub-exposures where they differ from the reference by more than photon noise.

    D^2 is the squared difference in units of its variance, averaged over a window. Above what noise explains, by e, the weight
    is `1 / (1 + e)`: the gain of a Wiener filter. Pixels that one of both did not see keep their weight.
    """
    response, scale, reference = parts.response, parts.scale, sums[parts.reference]
    fixed = parts.smoothed(reference, _DETAIL_PX)
    counts, weight, frames = reference.counts.copy(), reference.weight.copy(), reference.weight.copy()
    for each in (*sums[: parts.reference], *sums[parts.reference + 1 :]):
        image = parts.smoothed(each, _DETAIL_PX)
        error = blurred(image.squared_difference(fixed, response), _WINDOW_PX * scale)
        trust = np.where(where, 1 / (1 + np.maximum(error - np.float32(_TOLERATED), 0)), np.float32(1))
        counts += trust * each.counts
        weight += trust * each.weight
        frames += each.weight
    return RobustSum(PhotonSum(counts, weight), np.asarray(weight / np.maximum(frames, np.float32(1e-3)), np.float32))


def _replaced(photons: PhotonSum, other: PhotonSum, where: NDArray[np.bool_]) -> PhotonSum:
    return PhotonSum(np.where(where, other.counts, photons.counts), np.where(where, other.weight, photons.weight))
