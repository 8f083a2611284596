"""Where frames land on a grid: told for all chunks at once, before any of them is summed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import apply, corners, inverse, rescaling
from photonpano.values import FloatArray, Homography

_LONG_RUN_PX = 96
"""Shorter runs of neighbours are warped faster pixel by pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class Landing:
    """How a frame is brought onto a grid.

    Attributes:
        shrink: so many pixels squared are averaged first.
        to_image: (3, 3), pixels of the grid to pixels of the frame, averaged.
        rows: those of the grid that it can touch; empty if it lies outside.
        columns: the same for columns.
        straight: it is hardly turned or enlarged, so that neighbours on a row of the grid see neighbours.
    """

    shrink: int
    to_image: Homography
    rows: range
    columns: range
    straight: bool


def landings(to_grid: FloatArray, frame_shape: tuple[int, int], grid_shape: tuple[int, int]) -> list[Landing]:
    """Tell how frames are brought onto a grid.

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
        Landing(int(factor), back, range(y0, y1), range(x0, x1), bool(flag))
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
    """Return the first (x, y) of the grid that each frame of (N, 4, 2) corners can touch, and the one after the last."""
    size = np.array([grid_shape[1], grid_shape[0]])
    low = np.clip(np.floor(outline.min(axis=1)) - 1, 0, size)
    high = np.clip(np.ceil(outline.max(axis=1)) + 2, low, size)
    return low.astype(int), high.astype(int)


def _run_px(to_image: FloatArray, low: np.ndarray, high: np.ndarray) -> FloatArray:
    """Return for how many pixels of a row, at the worst corner that a frame touches, each sees one pixel further right."""
    x, y = np.stack([low, high], axis=-1).transpose(1, 0, 2)
    places = np.stack([x[:, [0, 0, 1, 1]], y[:, [0, 1, 0, 1]], np.ones((len(x), 4))], axis=1)
    u, v, depth = (to_image @ places).transpose(1, 0, 2)
    along = to_image[:, 2, 0, None] / depth**2
    across = np.abs(to_image[:, 0, 0, None] / depth - u * along - 1), np.abs(to_image[:, 1, 0, None] / depth - v * along)
    return np.asarray(1 / np.maximum(np.maximum(*across), 1e-9).max(axis=1))
