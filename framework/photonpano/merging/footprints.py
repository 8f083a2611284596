"""Footprints of frames on a grid: which pixels each frame covers and how it is warped, for all chunks at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import apply, corners, inverse, rescaling
from photonpano.values import FloatArray, Homography

_LONG_RUN_PX = 96  # from this length of runs on, the compiled warp along runs is faster than OpenCV's warp, pixel by pixel


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """Where a frame lies on a grid, and how it is warped there.

    Attributes:
        shrink: squares of this many pixels a side are averaged before the warp.
        to_image: (3, 3), pixels of the grid to pixels of the averaged frame.
        rows: rows of the grid that the frame may touch; empty if it lies outside.
        columns: columns of the grid that the frame may touch; empty if it lies outside.
        straight: the frame is hardly rotated or scaled, so that neighbours on a row of the grid lie at neighbours of the frame.
    """

    shrink: int
    to_image: Homography
    rows: range
    columns: range
    straight: bool


def footprints_of(to_grid: FloatArray, frame_shape: tuple[int, int], grid_shape: tuple[int, int]) -> list[Footprint]:
    """Return the footprint of each frame on a grid.

    Args:
        to_grid: (N, 3, 3), pixels of each frame to pixels of the grid.
        frame_shape: (height, width) of a frame.
        grid_shape: (height, width) of the grid.
    """
    shrink = _shrink_factors(to_grid, frame_shape)
    to_grid = to_grid @ np.array([rescaling(factor) for factor in shrink])
    low, high = _touched(apply(to_grid, [corners(_shrunk(frame_shape, factor)) for factor in shrink]), grid_shape)
    to_image = inverse(to_grid)
    straight = _run_px(to_image, low, high) >= _LONG_RUN_PX
    return [
        Footprint(int(factor), back, range(y0, y1), range(x0, x1), bool(flag))
        for factor, back, (x0, y0), (x1, y1), flag in zip(shrink, to_image, low.tolist(), high.tolist(), straight, strict=True)
    ]


def _shrunk(shape: tuple[int, int], factor: int) -> tuple[int, int]:
    return -(-shape[0] // factor), -(-shape[1] // factor)


def _shrink_factors(to_grid: FloatArray, frame_shape: tuple[int, int]) -> list[int]:
    """Return how many pixels in a row fall on one grid pixel: bilinear sampling alone would skip photons."""
    centre = np.array([[(frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2]])
    around = apply(to_grid, centre + np.array([[0, 0], [1, 0], [0, 1]]))
    step = np.linalg.norm(around[:, 1:] - around[:, :1], axis=-1).max(axis=-1)
    return [max(1, int(factor)) for factor in 1 / step + 1e-6]


def _touched(outline: FloatArray, grid_shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first (x, y) of the grid that each frame of (N, 4, 2) corners may touch, and the one after the last."""
    size = np.array([grid_shape[1], grid_shape[0]])
    low = np.clip(np.floor(outline.min(axis=1)) - 1, 0, size)
    high = np.clip(np.ceil(outline.max(axis=1)) + 2, low, size)
    return low.astype(int), high.astype(int)


def _run_px(to_image: FloatArray, low: np.ndarray, high: np.ndarray) -> FloatArray:
    """Return the length of runs along a row on which each step of a pixel is one of the frame, at each frame's worst corner."""
    x, y = np.stack([low, high], axis=-1).transpose(1, 0, 2)
    places = np.stack([x[:, [0, 0, 1, 1]], y[:, [0, 1, 0, 1]], np.ones((len(x), 4))], axis=1)
    u, v, depth = (to_image @ places).transpose(1, 0, 2)
    along = to_image[:, 2, 0, None] / depth**2
    across = np.abs(to_image[:, 0, 0, None] / depth - u * along - 1), np.abs(to_image[:, 1, 0, None] / depth - v * along)
    return np.asarray(1 / np.maximum(np.maximum(*across), 1e-9).max(axis=1))
