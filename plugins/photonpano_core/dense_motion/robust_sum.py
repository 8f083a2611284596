"""Weights of sub-exposures that leave out what contradicts the reference sub-exposure, along whichever motion explains most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonpano import BoolArray
from photonpano.merging import PhotonSum
from photonpano_core.dense_motion.field import Image, MotionField
from photonpano_core.dense_motion.sub_exposures import SCALE, SubExposures, blurred

# Blur of sub-exposures, and the window over which their differences are averaged, in px of a frame.
_DETAIL_PX, _WINDOW_PX = 0.9, 1.2
_TOLERATED = 1.5  # squared difference, in units of the photon noise, that costs no weight
_EXPLAINED = 0.8  # share of the frames that must agree, or other motions are tried
_MOVES_PX = 1.0  # motion within a group that a neighbour takes over, in px of a frame


@dataclass(frozen=True, slots=True, eq=False)
class Weighted:
    """Motion of each pixel, and weights of the sub-exposures along it."""

    field: MotionField
    trusts: Image  # (K, H, W), weights from 0 to 1
    explained: Image  # (H, W), share of the frames of a pixel that remain

    def improved(self, other: Weighted, where: BoolArray) -> Weighted:
        """Return what takes, within `where`, each pixel from the one that explains more frames."""
        better = where & (other.explained > self.explained)
        return Weighted(
            MotionField(np.where(better[..., None], other.field.coefficients, self.field.coefficients)),
            np.where(better, other.trusts, self.trusts),
            np.where(better, other.explained, self.explained),
        )


def weighted(parts: SubExposures, field: MotionField, where: BoolArray) -> Weighted:
    """Find, for each of some pixels (H, W), the motion beyond the global one that explains most of its frames.

    A field is smooth, but the motion jumps at the border of an object. Where the field explains too few frames, a pixel may
    move as its nearest neighbour that moves and is explained, or not at all beyond the global motion.
    """
    sums = parts.along(field, where)
    best = _weighted(parts, field, sums)
    poor = where & (best.explained < _EXPLAINED)
    if not poor.any():
        return best
    movers = where & ~poor & (field.way_px > _MOVES_PX * SCALE)
    if movers.any():
        nearest = field.filled(movers)
        best = best.improved(_weighted(parts, nearest, parts.along(nearest, poor, sums)), poor)
    still = MotionField(np.zeros_like(field.coefficients))
    return best.improved(_weighted(parts, still, parts.sums), poor)


def _weighted(parts: SubExposures, field: MotionField, sums: Sequence[PhotonSum]) -> Weighted:
    """Weight sub-exposures where they differ from the reference by more than photon noise.

    D^2 is the squared difference in units of its variance, averaged over a window. If it exceeds the tolerance by e, the weight
    is `1 / (1 + e)`, the gain of a Wiener filter; it is 1 where either is unseen.
    """
    fixed = parts.smoothed(sums[parts.reference], _DETAIL_PX)
    trusts = np.ones((len(sums), *parts.shape), np.float32)
    weight, frames = sums[parts.reference].weight.copy(), sums[parts.reference].weight.copy()
    for place, each in enumerate(sums):
        if place == parts.reference:
            continue
        image = parts.smoothed(each, _DETAIL_PX)
        error = blurred(image.squared_difference(fixed, parts.response), _WINDOW_PX * SCALE)
        trusts[place] = 1 / (1 + np.maximum(error - np.float32(_TOLERATED), 0))
        weight += trusts[place] * each.weight
        frames += each.weight
    return Weighted(field, trusts, np.asarray(weight / np.maximum(frames, np.float32(1e-3)), np.float32))
