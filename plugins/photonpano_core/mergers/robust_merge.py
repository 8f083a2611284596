"""Robust merging: moving objects leave no ghosts (after Ma et al. 2020, "Quanta Burst Photography")."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, Group, Response, Source, Trajectory, VirtualExposure
from photonpano.merging import PhotonSum, accumulate, chunks_of
from photonpano_core.configs import RobustMergeConfig
from photonpano_core.mergers.dense_motion.frames import blurred
from photonpano_core.mergers.photon_mle import exposure_of, exposure_shape, parts_of, to_exposure, unwarped_sum

Image = NDArray[np.float32]

_MIN_WEIGHT = 1e-3  # smoothed weight of the overlap above which blocks are compared


class RobustMerger:
    """Divides a group into blocks of frames, and weights each where it differs from the block around the reference instant.

    D is the difference of two smoothed blocks. Where D^2 exceeds the tolerance for photon noise and motion errors by e, the
    block has the weight `s^2 / (s^2 + e)`, with the standard deviation s of the noise of D: the gain of a Wiener filter. Counts
    and weights are multiplied alike, so that the weight remains the number of frames in which a pixel was seen.

    A block has its full weight where the reference block does not overlap it, as at the borders of the exposure, and everywhere
    while no motion is known, since the motion of the scene is then not separable from that of the camera.
    """

    def __init__(self, config: RobustMergeConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        photons = unwarped_sum(source, group, scale) if trajectory is None else self._sum(source, group, trajectory, scale)
        return exposure_of(photons, source, group, scale)

    def _sum(self, source: Source, group: Group, trajectory: Trajectory, scale: float) -> PhotonSum:
        onto, shape = to_exposure(group, trajectory, scale), exposure_shape(source, scale)

        def summed(span: FrameSpan) -> PhotonSum:
            chunks = chunks_of(span, trajectory, source.info.frame_shape, self._config.tolerance_px)
            return accumulate(source, chunks, onto, shape)

        blocks, middle = parts_of(group, self._config.blocks)
        reference = summed(blocks[middle])
        counts, weight = reference.counts.copy(), reference.weight.copy()
        for place, block in enumerate(blocks):
            if place != middle:
                photons = summed(block)
                trust = trust_weights(photons, reference, source.response, self._config, scale)
                counts += trust * photons.counts
                weight += trust * photons.weight
        return PhotonSum(counts, weight)


def trust_weights(block: PhotonSum, reference: PhotonSum, response: Response, config: RobustMergeConfig, scale: float) -> Image:
    """Return the weights of a block's pixels, (H, W) from 0 to 1, by its difference from the block at the reference instant.

    Both are smoothed with the same weights, and compared on the scale on which photon noise is uniform. `scale` is in pixels of
    the exposure per pixel of a frame.
    """
    blur_px = config.smoothing_px * scale
    # The weights for which the smoothed difference has the least variance; 0 where a block saw nothing.
    both = block.weight * reference.weight / np.maximum(block.weight + reference.weight, np.float32(1e-6))
    smoothed = blurred(both, blur_px)
    seen = smoothed > _MIN_WEIGHT
    norm: Image = np.where(seen, smoothed, np.float32(1))
    # The square of a Gaussian is a narrower Gaussian. Noise is independent between pixels of frames, not of the exposure.
    squares = blurred(both, blur_px / math.sqrt(2)) / np.float32(4 * math.pi * config.smoothing_px**2)
    frames = np.maximum(norm**2 / np.maximum(squares, np.float32(1e-9)), np.float32(1))
    means: list[Image] = [blurred(both * _mean(each), blur_px) / norm for each in (block, reference)]
    first, second = (response.stabilised(response.flux(mean, frames), frames) for mean in means)
    variance = response.stabilised_std(frames) ** 2
    slope = np.hypot(*np.gradient(second)) * np.float32(config.tolerated_px * scale)
    tolerated = np.float32(config.tolerated_std**2) * variance + slope**2
    excess = np.maximum((first - second) ** 2 - tolerated, 0)
    return np.where(seen, variance / (variance + excess), np.float32(1)).astype(np.float32, copy=False)


def _mean(photons: PhotonSum) -> Image:
    """Return the mean count per frame; 0 where nothing was seen."""
    return np.divide(photons.counts, photons.weight, out=np.zeros_like(photons.counts), where=photons.weight > 0)
