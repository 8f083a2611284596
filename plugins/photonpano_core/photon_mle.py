"""Maximum-likelihood merging of binary frames along a motion (paper, section 4, "Merge", and equation 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

import numpy as np

from photonpano import Group, Source, Trajectory, VirtualExposure
from photonpano.geometry import inverse, rescaling
from photonpano.merging import Chunk, CountsCache, accumulate, chunks_of, clipped
from photonpano_core.configs import PhotonMleConfig
from photonpano_core.exposures import scaled_shape

Decide = Callable[[str, float, str], None]

_SHARED_BYTES = 64 * 1024**2
"""Sums that overlapping groups share are kept up to this: a group of them."""


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
        self._along: _Along | None = None
        self._lock = Lock()

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        shape = scaled_shape(source.info.frame_shape, scale)
        if trajectory is None or not self._config.compensate:
            still = Chunk(group.span, np.eye(3))
            photons = accumulate(source, [still], rescaling(scale), shape)
        else:
            along = self._chunked(source, trajectory)
            chunks = clipped(along.chunks, group.span, trajectory)
            to_reference = inverse(trajectory.at([group.reference])[0])
            photons = accumulate(source, chunks, rescaling(scale) @ to_reference, shape, counts_of=along.counts)
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)

    def _chunked(self, source: Source, trajectory: Trajectory) -> _Along:
        """Return the chunks of a capture along a motion, which the groups of a level share."""
        with self._lock:
            known = self._along
            if known is not None and known.source is source and known.trajectory is trajectory:
                return known
            tolerance_px = self._config.tolerance_px
            chunks = chunks_of(source.info.span, trajectory, source.info.frame_shape, tolerance_px)
            if self._decide is not None:
                self._decide(
                    "chunk_frames",
                    round(source.info.n_frames / len(chunks), 1),
                    f"so many frames, on average, move less than tolerance_px = {tolerance_px:g} along the motion, "
                    "and are summed before they are warped",
                )
            self._along = _Along(source, trajectory, chunks, CountsCache(source, _SHARED_BYTES))
            return self._along


@dataclass(frozen=True, slots=True, eq=False)
class _Along:
    """What the groups of a level share: the chunks of the capture along a motion, and their sums."""

    source: Source
    trajectory: Trajectory
    chunks: tuple[Chunk, ...]
    counts: CountsCache
