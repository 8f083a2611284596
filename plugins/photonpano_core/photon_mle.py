"""Maximum-likelihood merging of binary frames along a motion (paper, section 4, "Merge", and equation 3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano import VirtualExposure
from photonpano.geometry import inverse, rescaling
from photonpano.merging import Chunk, accumulate, chunks_of

if TYPE_CHECKING:
    from photonpano import Group, Source, Trajectory
    from photonpano_core.configs import PhotonMleConfig


class PhotonMleMerger:
    """Warps the counts of a group to its reference instant and estimates the flux once.

    Warping relative to the reference instant, not to the panorama, keeps the warps small. A pixel lit in every frame gets the
    flux that `BinaryResponse` states; a pixel that was seen in less than one whole frame is unknown.
    """

    def __init__(self, config: PhotonMleConfig) -> None:
        self._config = config

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        shape = _scaled_shape(source.info.frame_shape, scale)
        if trajectory is None or not self._config.compensate:
            still = Chunk(group.span, np.eye(3))
            photons = accumulate(source, [still], rescaling(scale), shape)
        else:
            chunks = chunks_of(group.span, trajectory, source.info.frame_shape, self._config.tolerance_px)
            to_reference = inverse(trajectory.at([group.reference])[0])
            photons = accumulate(source, chunks, rescaling(scale) @ to_reference, shape)
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)


def _scaled_shape(shape: tuple[int, int], scale: float) -> tuple[int, int]:
    height, width = shape
    return max(1, round(height * scale)), max(1, round(width * scale))
