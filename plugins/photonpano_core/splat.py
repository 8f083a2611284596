"""Merging by splatting: each lit pixel is warped along the motion of its own frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import (
    FloatArray,
    FrameSpan,
    Group,
    InputError,
    LensedSource,
    LinearlyCorrectedSource,
    LitSource,
    Source,
    Trajectory,
    VirtualExposure,
)
from photonpano.geometry import apply, corners, inverse
from photonpano.merging import PhotonSum, gain_image
from photonpano_core.photon_mle import exposure_of, exposure_shape, to_exposure, unwarped_sum
from photonpano_core.splatting import add_coverage, splat

_READ_BYTES = 1024**2  # unpacked frames read at a time: about the cache of a core
_RIGID = 0.01  # deviation of the pixel spacing from 1 px below which splat weights sum to 1 within its square


class SplatMerger:
    """Warps lit pixels one by one, sums them, and estimates the flux once (paper, equation 3).

    Frames are not summed before they are warped, so that no photon is misplaced. Dark pixels cost nothing: the time per frame
    grows with the number of its photons, not with the motion. The weight is the warp of frames of ones, so that the quotient is
    not biased at masks, at borders and where the grid is finer than a frame. In changing light it is multiplied by the mean
    gain of the group.
    """

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`.

        Raises:
            InputError: the source corrects sums of frames, which this merger does not make, or its lens distorts.
        """
        if isinstance(source, LinearlyCorrectedSource):
            raise InputError(
                "merge.use: splat warps photons one by one, so that it cannot subtract dark counts, interpolate pixels or "
                "compare colours; use photon-mle, or only corrections that move or mask pixels"
            )
        if isinstance(source, LensedSource) and source.camera.distorts:
            raise InputError("merge.use: splat does not warp through a lens that distorts; use photon-mle")
        if trajectory is None:
            photons = unwarped_sum(source, group, scale)
        else:
            frames = np.arange(group.span.start, group.span.stop)
            to_grid = to_exposure(group, trajectory, scale) @ trajectory.at(frames)
            to_grid /= np.cbrt(np.linalg.det(to_grid))[:, None, None]
            photons = _splatted(source, group.span, to_grid, exposure_shape(source, scale))
            if isinstance(source, LitSource):
                to_plane = inverse(to_exposure(group, trajectory, scale))
                gain = gain_image(source.light, group.span, to_plane, exposure_shape(source, scale))
                photons = PhotonSum(photons.counts, photons.weight * gain)
        return exposure_of(photons, source, group, scale)


def _splatted(source: Source, span: FrameSpan, to_grid: FloatArray, shape: tuple[int, int]) -> PhotonSum:
    """Sum frames on a grid, each warped by its own (3, 3) map of determinant 1."""
    counts = _with_margin(shape)
    height, width = source.info.frame_shape
    for part in span.blocks(max(1, _READ_BYTES // (height * width))):
        maps = to_grid[part.start - span.start : part.stop - span.start]
        splat(source.frames(part), source.valid, maps, counts)
    return PhotonSum(_without_margin(counts), _weight(source.valid, to_grid, shape))


def _weight(valid: NDArray[np.bool_], to_grid: FloatArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the sum of splats of the valid pixels of frames of ones: (H, W)."""
    weight = np.zeros(shape, np.float32)
    rigid = _rigid(to_grid, valid.shape)
    if rigid:
        steps = np.zeros((shape[0], shape[1] + 1), np.float32)
        add_coverage(valid.shape, inverse(to_grid), weight, steps)
        weight += np.cumsum(steps, axis=1)[:, :-1]
    each = _with_margin(shape)
    counted = ~valid if rigid else valid
    if counted.any():
        ones = np.ones((1, *valid.shape), np.uint8)
        for one in to_grid[:, None]:
            splat(ones, counted, one, each)
    return np.maximum(weight - _without_margin(each), 0) if rigid else _without_margin(each)


def _rigid(to_grid: FloatArray, frame_shape: tuple[int, int]) -> bool:
    """Return whether the pixels of all frames stay 1 px apart, so that weights need not be splatted."""
    neighbours = corners(frame_shape)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    placed = apply(to_grid, neighbours.reshape(-1, 2)).reshape(len(to_grid), 4, 3, 2)
    return bool(np.abs(placed[:, :, 1:] - placed[:, :, :1] - np.eye(2)).max() < _RIGID)


def _with_margin(shape: tuple[int, int]) -> NDArray[np.float32]:
    return np.zeros((shape[0] + 2, shape[1] + 2), np.float32)


def _without_margin(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(grid[1:-1, 1:-1])
