"""Merging along a dense field of motion: `local-flow` (paper, section 6, "Dense Motion Models")."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FrameSpan, Group, Source, Trajectory, VirtualExposure
from photonpano.geometry import inverse
from photonpano.merging import PhotonSum, accumulate, chunks_of, clipped
from photonpano_core.configs import LocalFlowConfig
from photonpano_core.mergers.dense_motion.fields import Frames, Moved, Sums, add_along
from photonpano_core.mergers.dense_motion.moving import GhostMap, compared, estimate_field, weighted
from photonpano_core.mergers.dense_motion.sub_exposures import SCALE, SubExposures, WeightedFrames, rescaled, sharpened
from photonpano_core.mergers.photon_mle import exposure_of, exposure_shape, require_plain, to_exposure, unwarped_sum

# Numbers of sub-exposures that are tried for a group, with the photons per pixel that each must have.
_NUMBERS = {33: 8.0, 17: 8.0, 9: 2.0, 5: 2.0, 3: 2.0}
_USUAL = 17  # sub-exposures, at most, unless something moves fast
_COMPARED = 9  # sub-exposures, at most, whose differences show what moves: fewer have more light each
_SAMPLED = 16  # frames that are sampled for the mean flux of a group
_AROUND_PX = 6  # dilation of the moving pixels that are merged along the field, in px of a frame
_SWEPT_PX = 6.0  # motion within a sub-exposure, in px of a frame, above which a group is divided into more of them
_MARGIN_PX = 32  # margin around these in which flow is estimated, in px of a frame


class LocalFlowMerger:
    """Warps the counts of a group along the global motion, and where they contradict it, along a dense field beyond it.

    A group is divided into sub-exposures of half the size. Where these agree, all frames are merged as `photon-mle` does, to
    the same flux. Elsewhere optical flow is estimated in rounds. Sub-exposures that still differ from the one around the
    reference instant, such as those in which a pixel is occluded, get less weight. Then counts are warped along the sum of both
    motions, in one interpolation at full size, and its blur is undone where noise allows it.

    In a group with too few photons, and while no motion is known, frames are merged as `photon-mle` does.
    """

    def __init__(self, config: LocalFlowConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`. Raises an `InputError` if the lens distorts, or the light changes."""
        if trajectory is None:
            return exposure_of(unwarped_sum(source, group, scale), source, group, scale)
        photons = self._merged(source, group, trajectory, max(scale, 1.0))
        return exposure_of(rescaled(photons, scale) if scale < 1 else photons, source, group, scale)

    def ghost_map(self, source: Source, group: Group, trajectory: Trajectory) -> GhostMap:
        """Find the pixels of a group whose photons contradict the global motion, on the grid of a frame."""
        found = self._ghosts(self._divided(source, group, trajectory))
        shape = source.info.frame_shape
        return GhostMap(enlarged(found.significance, shape), enlarged(found.moving, shape))

    def _divided(self, source: Source, group: Group, trajectory: Trajectory) -> SubExposures:
        require_plain(source, "local-flow")
        wanted = self._config.sub_exposures
        number = min(number_of(source, group), _USUAL) if wanted == "auto" else wanted
        return SubExposures(source, group, trajectory, number)

    def _ghosts(self, parts: SubExposures) -> GhostMap:
        config = self._config
        return compared(parts, min(_COMPARED, len(parts.spans)), config.significance, config.tolerated_px)

    def _merged(self, source: Source, group: Group, trajectory: Trajectory, scale: float) -> PhotonSum:
        parts, tolerance_px = self._divided(source, group, trajectory), self._config.tolerance_px
        chunks = chunks_of(group.span, trajectory, source.info.frame_shape, tolerance_px)
        onto = to_exposure(group, trajectory, scale)
        total = accumulate(source, chunks, onto, exposure_shape(source, scale))
        moving = self._ghosts(parts).moving
        if not moving.any():
            return total
        side = 2 * round(_AROUND_PX * SCALE) + 1
        where = cv2.dilate(moving.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))).astype(bool)
        box = box_around(where, round(_MARGIN_PX * SCALE))
        there = where[box]
        field = estimate_field(parts.cropped(box), there)
        if self._config.sub_exposures == "auto" and 2 * parts.fastest_px(field, there) > _SWEPT_PX * len(parts.spans):
            parts = parts.divided(number_of(source, group))
        parts = parts.cropped(box)
        best = weighted(parts, field, there)
        fastest_px = parts.fastest_px(best.field, there)
        inside = enlarged(where, total.counts.shape, scale)
        counts, weight = (np.where(inside, np.float32(0), each) for each in (total.counts, total.weight))
        sums = Sums(counts, weight, np.zeros_like(weight))
        frames, cells = WeightedFrames(source, group), (SCALE / scale, box[0].start, box[1].start)
        for span, trust in zip(parts.spans, best.trusts, strict=True):
            for chunk, motion in parts.moving(clipped(chunks, span, trajectory), best.field, fastest_px, tolerance_px):
                to_image = inverse(onto @ chunk.homography)
                summed = Frames(frames(chunk.span), frames.weights, float(len(chunk.span)))
                add_along(summed, to_image, Moved(inside, cells, motion, trust), sums)
        photons = PhotonSum(sums.counts, sums.weight)
        if scale > 1:
            return photons  # Its neighbouring pixels share more noise than `sharpened` expects.
        blur_px2 = np.asarray(sums.blur / np.maximum(sums.weight, np.float32(1e-3)), np.float32)
        return sharpened(photons, blur_px2, inside, source.response)


def enlarged(image: NDArray[Any], shape: tuple[int, int], scale: float = 1.0) -> NDArray[Any]:
    """Return an image of the grid of `SubExposures`, (h, w), on a grid of another scale, (H, W), without interpolation."""
    rows, columns = (
        np.minimum(((np.arange(length) + 0.5) * (SCALE / scale)).astype(int), size - 1)
        for length, size in zip(shape, image.shape, strict=True)
    )
    return image[np.ix_(rows, columns)]


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
