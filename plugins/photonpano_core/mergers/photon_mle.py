"""Maximum-likelihood merging of frames along a motion (paper, section 4, "Merge", and equation 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import Lock

import numpy as np

from photonpano import FrameSpan, Group, Homography, InputError, Source, Trajectory, VirtualExposure, capture_of
from photonpano.geometry import inverse, rescaling
from photonpano.merging import Chunk, CountsCache, PhotonSum, accumulate, chunks_of, clipped, divided
from photonpano_core.configs import PhotonMleConfig

Decide = Callable[[str, float, str], None]

_CACHE_BYTES = 64 * 1024**2  # for the sums that overlapping groups share: about those of one group


class PhotonMleMerger:
    """Warps the counts of a group to its reference instant and estimates the flux once.

    Warps are relative to the reference instant, not to the panorama, so that they are small. A pixel lit in every frame gets
    the flux that `BinaryResponse` states; a pixel that was seen in less than one whole frame is unknown.
    """

    def __init__(self, config: PhotonMleConfig, decide: Decide | None = None) -> None:
        """Take the keys of the spec, and what records the mean length of chunks along each motion, with the reason."""
        self._config, self._decide = config, decide
        self._shared: _Shared | None = None
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[PhotonMleMerger], tuple[PhotonMleConfig, Decide | None]]:
        """Travel without the sums of chunks."""
        return PhotonMleMerger, (self._config, self._decide)

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`."""
        if trajectory is None or not self._config.compensate:
            photons = unwarped_sum(source, group, scale)
        else:
            shared = self._shared_along(source, trajectory)
            chunks = clipped(shared.chunks, group.span, trajectory)
            shape = exposure_shape(source, scale)
            photons = accumulate(source, chunks, to_exposure(group, trajectory, scale), shape, counts_of=shared.counts)
        return exposure_of(photons, source, group, scale)

    def _shared_along(self, source: Source, trajectory: Trajectory) -> _Shared:
        with self._lock:
            shared = self._shared
            if shared is None or shared.source is not source or shared.trajectory is not trajectory:
                tolerance_px = self._config.tolerance_px
                cuts = [each.start for each in capture_of(source).pieces(source.info.span)]
                chunks = chunks_of(source.info.span, trajectory, source.info.frame_shape, tolerance_px, cuts)
                if self._decide is not None:
                    self._decide(
                        "chunk_frames",
                        round(source.info.n_frames / len(chunks), 1),
                        f"mean number of consecutive frames that move less than tolerance_px = {tolerance_px:g}; they are "
                        "summed before they are warped",
                    )
                shared = self._shared = _Shared(source, trajectory, chunks, CountsCache(source, _CACHE_BYTES))
            return shared


@dataclass(frozen=True, slots=True, eq=False)
class _Shared:
    """Chunks of a capture along a motion, with their sums: shared by the groups of a level."""

    source: Source
    trajectory: Trajectory
    chunks: tuple[Chunk, ...]
    counts: CountsCache


def equal_spans(span: FrameSpan, n: int) -> list[FrameSpan]:
    """Divide a span into `n` spans of nearly the same length; one at least."""
    return [FrameSpan(span.start + part.start, span.start + part.stop) for part in divided(len(span), max(1, n))]


def parts_of(group: Group, n: int) -> tuple[list[FrameSpan], int]:
    """Divide a group into `n` spans, and return also the index of the one that contains the reference instant."""
    spans = equal_spans(group.span, n)
    return spans, next(place for place, span in enumerate(spans) if group.reference < span.stop)


def require_plain(source: Source, merger: str) -> None:
    """Raise an `InputError` for a lens that distorts, or light that changes, which `photon-mle` handles."""
    capture = capture_of(source)
    if capture.camera is not None and capture.camera.distorts:
        raise InputError(f"merge.use: {merger} does not warp through a lens that distorts; use photon-mle")
    if capture.light is not None:
        raise InputError(f"merge.use: {merger} does not divide by light that changes; use photon-mle")


def exposure_shape(source: Source, scale: float) -> tuple[int, int]:
    """Return the (height, width) of an exposure."""
    height, width = source.info.frame_shape
    return max(1, round(height * scale)), max(1, round(width * scale))


def to_exposure(group: Group, trajectory: Trajectory, scale: float) -> Homography:
    """Return (3, 3): pixels of the reference plane to pixels of the exposure, at the group's reference instant."""
    return rescaling(scale) @ inverse(trajectory.at([group.reference])[0])


def unwarped_sum(source: Source, group: Group, scale: float) -> PhotonSum:
    """Sum the frames of a group as they are, while no motion is known."""
    chunks = [Chunk(each, np.eye(3)) for each in capture_of(source).pieces(group.span)]
    return accumulate(source, chunks, rescaling(scale), exposure_shape(source, scale))


def exposure_of(photons: PhotonSum, source: Source, group: Group, scale: float) -> VirtualExposure:
    """Estimate the flux of a sum."""
    flux, weight = photons.estimate(source.response)
    return VirtualExposure(flux, weight, group, scale, source.response)
