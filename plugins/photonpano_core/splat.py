"""Merging by splatting: each lit pixel of each frame is put where the motion of exactly that frame says."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, FrameSpan, Group, InputError, LinearlyCorrectedSource, Source, Trajectory, VirtualExposure
from photonpano.geometry import apply, corners, inverse
from photonpano.merging import PhotonSum
from photonpano_core.exposures import scaled_shape, summed_as_they_lie, to_exposure
from photonpano_core.splatting import add_coverage, splat

_READ_BYTES = 1024**2
"""So much of unpacked frames is held at a time: about what a core's cache holds."""
_RIGID = 0.01
"""Where neighbours land a pixel apart along both axes but for e, weights add up to 1 but for about e^2."""


class SplatMerger:
    """Sums lit pixels, each at its own place, and estimates the flux once (paper, equation 3).

    Nothing is summed before it is warped, so that no photon is misplaced, and what is dark costs nothing: the time of a frame
    grows with the number of its photons, and not with the motion. Weights are those of a frame of ones, put there in the
    same way, so that their quotient is not biased at masks, borders and where the grid is finer than a frame.
    """

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        """Merge a group; see `photonpano.Merger`.

        Raises:
            InputError: something is to be taken out of sums, of which this merger makes none.
        """
        if isinstance(source, LinearlyCorrectedSource):
            raise InputError(
                "splat puts photons one by one, so that dark counts cannot be taken out, nor pixels interpolated: merge with "
                "photon-mle, or let corrections only move and mask pixels"
            )
        if trajectory is None:
            photons = summed_as_they_lie(source, group, scale)
        else:
            frames = np.arange(group.span.start, group.span.stop)
            to_grid = to_exposure(group, trajectory, scale) @ trajectory.at(frames)
            to_grid /= np.cbrt(np.linalg.det(to_grid))[:, None, None]
            photons = _splatted(source, group.span, to_grid, scaled_shape(source.info.frame_shape, scale))
        flux, weight = photons.estimate(source.response)
        return VirtualExposure(flux, weight, group, scale, source.response)


def _splatted(source: Source, span: FrameSpan, to_grid: FloatArray, shape: tuple[int, int]) -> PhotonSum:
    """Sum frames on a grid, each along its own (3, 3) map, which has the determinant 1."""
    counts = _with_margin(shape)
    for part in _parts(span, source.info.frame_shape):
        maps = to_grid[part.start - span.start : part.stop - span.start]
        splat(source.frames(part), source.valid, maps, counts)
    return PhotonSum(_without_margin(counts), _weight(source.valid, to_grid, shape))


def _weight(valid: NDArray[np.bool_], to_grid: FloatArray, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return what splats of valid pixels add up to, in frames: (H, W)."""
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
    """Tell whether neighbours of all frames land a pixel apart, so that weights need not be splatted."""
    neighbours = corners(frame_shape)[:, None] + np.array([[0, 0], [1, 0], [0, 1]])
    placed = apply(to_grid, neighbours.reshape(-1, 2)).reshape(len(to_grid), 4, 3, 2)
    return bool(np.abs(placed[:, :, 1:] - placed[:, :, :1] - np.eye(2)).max() < _RIGID)


def _parts(span: FrameSpan, frame_shape: tuple[int, int]) -> Iterator[FrameSpan]:
    step = max(1, _READ_BYTES // (frame_shape[0] * frame_shape[1]))
    for start in range(span.start, span.stop, step):
        yield FrameSpan(start, min(start + step, span.stop))


def _with_margin(shape: tuple[int, int]) -> NDArray[np.float32]:
    return np.zeros((shape[0] + 2, shape[1] + 2), np.float32)


def _without_margin(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(grid[1:-1, 1:-1])
