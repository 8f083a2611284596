"""Merging along a dense field of motion: `local-flow` (paper, section 6, "Dense Motion Models")."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano import BoolArray, FrameSpan, Group, InputError, LensedSource, LitSource, Source, Trajectory, VirtualExposure
from photonpano.merging import PhotonSum
from photonpano_core.configs import LocalFlowConfig
from photonpano_core.dense_motion.flow import estimate_field
from photonpano_core.dense_motion.ghosts import GhostMap, compared
from photonpano_core.dense_motion.rescaled import rescaled
from photonpano_core.dense_motion.robust_sum import best_sum
from photonpano_core.dense_motion.sub_exposures import SubExposures, total_of
from photonpano_core.photon_mle import exposure_of, unwarped_sum

_NUMBERS = {33: 8.0, 17: 8.0, 9: 2.0, 5: 2.0, 3: 2.0}
"""Numbers of sub-exposures that are tried for a group, with the photons per pixel that each must have."""
_COMPARED = 9
"""Sub-exposures, at most, whose differences show what moves: fewer have more light each."""
_SAMPLED = 16
"""Frames from which the light of a group is measured."""
_AROUND_PX = 6
"""Surroundings of what moves that are merged along the field as well, in px of a frame."""
_MARGIN_PX = 32
"""Surroundings of these in which flow is estimated, in px of a frame."""


class LocalFlowMerger:
    """Warps the counts of a group along the global motion, and where they contradict it, along a dense field beyond it.

    A group is divided into sub-exposures. Where these agree, as everywhere in a still scene, all frames are merged as
    `photon-mle` does, to the same flux. Elsewhere optical flow is estimated in rounds, and counts are warped along the sum of
    both motions, in one interpolation. Sub-exposures that still differ from the one around the reference instant, such as those
    in which a pixel is occluded, get less weight.

    In a group with too few photons, and while no motion is known, frames are merged as `photon-mle` does.
    """

    def __init__(self, config: LocalFlowConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`.

        Raises:
            InputError: the lens of the source distorts, or its light changes.
        """
        if trajectory is None:
            return exposure_of(unwarped_sum(source, group, scale), source, group, scale)
        photons = self._merged(self._divided(source, group, trajectory, max(scale, 1.0)))
        return exposure_of(rescaled(photons, scale) if scale < 1 else photons, source, group, scale)

    def ghost_map(self, source: Source, group: Group, trajectory: Trajectory) -> GhostMap:
        """Find the pixels of a group whose photons contradict the global motion, on the grid of a frame.

        Raises:
            InputError: the lens of the source distorts, or its light changes.
        """
        return self._ghosts(self._divided(source, group, trajectory, 1.0))

    def _divided(self, source: Source, group: Group, trajectory: Trajectory, scale: float) -> SubExposures:
        if isinstance(source, LensedSource) and source.camera.distorts:
            raise InputError("merge.use: local-flow does not warp through a lens that distorts; use robust-merge or photon-mle")
        if isinstance(source, LitSource):
            raise InputError("merge.use: local-flow does not divide by light that changes; use robust-merge or photon-mle")
        wanted = self._config.sub_exposures
        number = number_of(source, group) if wanted == "auto" else wanted
        return SubExposures(source, group, trajectory, scale, number, self._config.tolerance_px)

    def _ghosts(self, parts: SubExposures) -> GhostMap:
        config = self._config
        return compared(parts, min(_COMPARED, len(parts.spans)), config.significance, config.tolerated_px)

    def _merged(self, parts: SubExposures) -> PhotonSum:
        total, moving = total_of(parts.sums), self._ghosts(parts).moving
        if moving.any():
            side = 2 * round(_AROUND_PX * parts.scale) + 1
            around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
            where = cv2.dilate(moving.astype(np.uint8), around).astype(bool)
            box = box_around(where, round(_MARGIN_PX * parts.scale))
            crop, there = parts.cropped(box), where[box]
            found = best_sum(crop, estimate_field(crop, there), there, self._config.tolerance_px)
            total.counts[box], total.weight[box] = found.counts, found.weight
        return total


def box_around(where: BoolArray, margin: int) -> tuple[slice, slice]:
    """Return the rows and columns of a box around some pixels, with a margin."""
    bounds = []
    for axis, length in enumerate(where.shape):
        places = np.flatnonzero(where.any(axis=1 - axis))
        bounds.append(slice(max(int(places[0]) - margin, 0), min(int(places[-1]) + 1 + margin, length)))
    return bounds[0], bounds[1]


def number_of(source: Source, group: Group) -> int:
    """Return how many sub-exposures a group has light for: from 33 to 3; 1 if it is too dark for any."""
    first = max(group.span.start, min(round(group.reference) - _SAMPLED // 2, group.span.stop - _SAMPLED))
    sample = FrameSpan(first, min(first + _SAMPLED, group.span.stop))
    counts = source.counts(sample)[source.valid]
    mean = np.atleast_1d(np.float32(counts.mean() / len(sample) if counts.size else 0))
    photons = float(source.response.flux(mean, len(sample) * max(counts.size, 1))[0]) * len(group.span)
    wanted = (number for number, each in _NUMBERS.items() if photons >= each * number and len(group.span) >= number)
    return next(wanted, 1)
