"""The lens of the simulated camera: radial distortion and vignetting.

Convention:
    Points are (x, y) in px of the frame, integers are pixel centres, sizes are (height, width). r is the distance from the
    middle of the frame, in half-diagonals: 1 at the corner pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import FloatArray
from photonpano.geometry import corners
from photonpano_simulator.config import Lens

_POINTS_OF_A_SIDE = 16


def undistorted(lens: Lens, points: ArrayLike, frame_shape: tuple[int, int]) -> FloatArray:
    """Return where a lens without distortion images what this lens images at (..., 2) points: see `Lens`."""
    middle = _middle(frame_shape)
    offsets = np.asarray(points, dtype=np.float64) - middle
    squared = _squared_distance(offsets, middle)[..., None]
    return np.asarray(middle + offsets / (1 + squared * (lens.k1 + squared * lens.k2)))


def distorts(lens: Lens) -> bool:
    """Return whether straight lines become curves."""
    return bool(lens.k1 or lens.k2)


def outline(lens: Lens, frame_shape: tuple[int, int]) -> FloatArray:
    """Return points around the frame, (N, 2), as a lens without distortion images them."""
    around = corners(frame_shape)
    if not distorts(lens):
        return around
    shares = np.arange(_POINTS_OF_A_SIDE)[:, None, None] / _POINTS_OF_A_SIDE
    return undistorted(lens, ((1 - shares) * around + shares * np.roll(around, -1, axis=0)).reshape(-1, 2), frame_shape)


def pixel_grid(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centres of all pixels: (H, W, 2)."""
    height, width = frame_shape
    return np.stack(np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height)), axis=-1)


def transmission(lens: Lens, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the share of the light in the middle that reaches each pixel: (H, W)."""
    middle = _middle(frame_shape)
    squared = _squared_distance(pixel_grid(frame_shape) - middle, middle)
    return (1 - lens.vignette * squared).astype(np.float32)


def _middle(frame_shape: tuple[int, int]) -> FloatArray:
    height, width = frame_shape
    return np.array([(width - 1) / 2, (height - 1) / 2])


def _squared_distance(offsets: FloatArray, middle: FloatArray) -> FloatArray:
    """Return r^2 of (..., 2) offsets from the middle."""
    return np.asarray((offsets**2).sum(axis=-1) / (middle**2).sum())
