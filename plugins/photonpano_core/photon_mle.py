"""Maximum-likelihood merging of binary frames along a motion (paper, section 4, "Merge", and equation 3)."""

from __future__ import annotations

from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from photonpano import VirtualExposure
from photonpano.geometry import inverse, rescaling
from photonpano.merging import Chunk, accumulate, chunks_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano import Group, Source, Trajectory
    from photonpano_core.configs import PhotonMleConfig

    Decide = Callable[[str, float, str], None]


class PhotonMleMerger:
    """Warps the counts of a group to its reference instant and estimates the flux once.

    Warping relative to the reference instant, not to the panorama, keeps the warps small. A pixel lit in every frame gets the
    flux that `BinaryResponse` states; a pixel that was seen in less than one whole frame is unknown.
    """

    def __init__(self, config: PhotonMleConfig, decide: Decide | None = None) -> None:
        """Prepare to merge.

        Args:
            config: what the spec says.
            decide: is told how long chunks are along each motion, and why.
        """
        self._config, self._decide = config, decide
        self._explained: Trajectory | None = None
        self._lock = Lock()

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        shape = _scaled_shape(source.info.frame_shape, scale)
        if trajectory is None or not self._config.compensate:
            still = Chunk(group.span, np.eye(3))
            photons = accumulate(source, [still], rescaling(scale), shape)
        else:
            self._explain(source, trajectory)
            chunks = chunks_of(group.span, trajectory, source.info.frame_shape, self._config.tolerance_px)
            to_reference = inverse(trajectory.at([group.reference])[0])
            photons = accumulate(source, chunks, rescaling(scale) @ to_reference, shape)
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)

    def _explain(self, source: Source, trajectory: Trajectory) -> None:
        """Record the length of chunks along a motion, once."""
        with self._lock:
            if self._decide is None or trajectory is self._explained:
                return
            self._explained = trajectory
            n_frames = source.info.n_frames
            count = len(chunks_of(source.info.span, trajectory, source.info.frame_shape, self._config.tolerance_px))
            self._decide(
                "chunk_frames",
                round(n_frames / count, 1),
                f"so many frames, on average, move less than tolerance_px = {self._config.tolerance_px:g} along the motion, "
                "and are summed before they are warped",
            )


def _scaled_shape(shape: tuple[int, int], scale: float) -> tuple[int, int]:
    height, width = shape
    return max(1, round(height * scale)), max(1, round(width * scale))
