"""Robust merging: what moves by itself leaves no ghosts (after Ma and others 2020, "Quanta Burst Photography")."""

from __future__ import annotations

import math
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, Group, Response, Source, Trajectory, VirtualExposure
from photonpano.merging import PhotonSum, accumulate, chunks_of
from photonpano_core.configs import RobustMergeConfig
from photonpano_core.exposures import scaled_shape, summed_as_they_lie, to_exposure

Image = NDArray[np.float32]

_LEAST_SHARE = 1e-3
"""Where less than this of a neighbourhood was seen by both, nothing is compared."""


class RobustMerger:
    """Divides a group into blocks of frames, and trusts each where it agrees with the block around the reference instant.

    Where the difference D of two smoothed blocks exceeds what photon noise and an inexact motion explain, a block counts for
    `s^2 / (s^2 + e)`: s is the standard deviation of the noise of D, and e what `D^2` exceeds the tolerated. It is the
    gain of a Wiener filter. Counts and weights shrink alike, so that the weight still says how many frames a pixel was seen in.

    A block that the reference block does not overlap, as at the borders of the exposure, has nothing to differ from, and counts
    fully. So does everything while no motion is known: the scene's motion cannot be told from the camera's.
    """

    def __init__(self, config: RobustMergeConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        if trajectory is None:
            photons = summed_as_they_lie(source, group, scale)
        else:
            photons = self._sum(source, group, trajectory, scale)
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)

    def _sum(self, source: Source, group: Group, trajectory: Trajectory, scale: float) -> PhotonSum:
        onto = to_exposure(group, trajectory, scale)
        shape = scaled_shape(source.info.frame_shape, scale)

        def summed(span: FrameSpan) -> PhotonSum:
            chunks = chunks_of(span, trajectory, source.info.frame_shape, self._config.tolerance_px)
            return accumulate(source, chunks, onto, shape)

        blocks = divided(group.span, self._config.blocks)
        middle = next(block for block in blocks if group.reference < block.stop)
        reference = summed(middle)
        counts, weight = reference.counts.copy(), reference.weight.copy()
        for block in blocks:
            if block != middle:
                photons = summed(block)
                trust = agreement(photons, reference, source.response, self._config, scale)
                counts += trust * photons.counts
                weight += trust * photons.weight
        return PhotonSum(counts, weight)


def divided(span: FrameSpan, parts: int) -> list[FrameSpan]:
    """Divide a span into parts of about the same length, of a frame at least."""
    parts = min(parts, len(span))
    bounds = [span.start + len(span) * part // parts for part in range(parts + 1)]
    return [FrameSpan(start, stop) for start, stop in pairwise(bounds)]


def agreement(block: PhotonSum, reference: PhotonSum, response: Response, config: RobustMergeConfig, scale: float) -> Image:
    """Return how far a block is to be trusted: (H, W), from 0 to 1.

    Both are smoothed over the same places with the same weights, and compared on the scale on which photon noise is uniform.

    Args:
        block: sums of some frames, on the grid of the exposure.
        reference: those of the frames around the reference instant.
        response: the camera's, which tells the noise.
        config: what is tolerated, in px of a frame.
        scale: pixels of the exposure per pixel of a frame.
    """
    blur_px = config.smoothing_px * scale
    # The weight of least variance of a difference; 0 where one of them saw nothing.
    both = block.weight * reference.weight / np.maximum(block.weight + reference.weight, np.float32(1e-6))
    smoothed = _blurred(both, blur_px)
    seen = smoothed > _LEAST_SHARE
    norm: Image = np.where(seen, smoothed, np.float32(1))
    # The square of a Gaussian is a narrower one. Noise is that of pixels of frames, however large those of the exposure are.
    squares = _blurred(both, blur_px / math.sqrt(2)) / np.float32(4 * math.pi * config.smoothing_px**2)
    frames = np.maximum(norm**2 / np.maximum(squares, np.float32(1e-9)), np.float32(1))
    means: list[Image] = [_blurred(both * _mean(each), blur_px) / norm for each in (block, reference)]
    first, second = (response.stabilised(response.flux(mean, frames), frames) for mean in means)
    variance = response.stabilised_std(frames) ** 2
    slope = np.hypot(*np.gradient(second)) * np.float32(config.tolerated_px * scale)
    tolerated = np.float32(config.tolerated_std**2) * variance + slope**2
    excess = np.maximum((first - second) ** 2 - tolerated, 0)
    return np.where(seen, variance / (variance + excess), np.float32(1)).astype(np.float32, copy=False)


def _mean(photons: PhotonSum) -> Image:
    """Return the mean count of a frame; 0 where nothing was seen."""
    return np.divide(photons.counts, photons.weight, out=np.zeros_like(photons.counts), where=photons.weight > 0)


def _blurred(image: Image, blur_px: float) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), blur_px, borderType=cv2.BORDER_CONSTANT), np.float32)
