"""The lens of the simulated camera: distortion and vignetting.

Convention:
    Points are (x, y) in px of the frame, integers are pixel centres, sizes are (height, width). r is the distance from the
    middle of the frame, in half-diagonals: 1 at the corner pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import FloatArray, InputError
from photonpano.geometry import Camera, corners
from photonpano_simulator.config import Lens, SimulationConfig

_POINTS_OF_A_SIDE = 16


def undistorted(config: SimulationConfig, points: ArrayLike) -> FloatArray:
    """Return where a lens without distortion images what this lens images at (..., 2) points: see `Lens` and `Distortion`."""
    points = np.asarray(points, dtype=np.float64)
    if not any(config.distortion.coefficients):
        middle = middle_of(config.frame_shape)
        offsets = points - middle
        squared = _squared_distance(offsets, middle)[..., None]
        return np.asarray(middle + offsets / (1 + squared * (config.lens.k1 + squared * config.lens.k2)))
    ideal = camera(config).ideal(points)
    if np.isnan(ideal).any():
        raise InputError(
            f"distortion folds the image of {config.frame_shape[0]}x{config.frame_shape[1]} px at the focal length of "
            f"{config.focal_length_px:g} px, so that nothing is imaged at its border; take smaller coefficients"
        )
    return ideal


def camera(config: SimulationConfig) -> Camera:
    """Return the camera with OpenCV's distortion, which looks through the middle of its frames."""
    return Camera.of(config.focal_length_px, config.frame_shape, config.distortion.coefficients)


def distorts(config: SimulationConfig) -> bool:
    """Return whether straight lines become curves."""
    return bool(config.lens.k1 or config.lens.k2 or any(config.distortion.coefficients))


def outline(config: SimulationConfig) -> FloatArray:
    """Return points around the frame, (N, 2), as a lens without distortion images them."""
    around = corners(config.frame_shape)
    if not distorts(config):
        return around
    shares = np.arange(_POINTS_OF_A_SIDE)[:, None, None] / _POINTS_OF_A_SIDE
    return undistorted(config, ((1 - shares) * around + shares * np.roll(around, -1, axis=0)).reshape(-1, 2))


def pixel_grid(frame_shape: tuple[int, int]) -> FloatArray:
    """Return the centres of all pixels: (H, W, 2)."""
    height, width = frame_shape
    return np.stack(np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height)), axis=-1)


def transmission(lens: Lens, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return the share of the light in the middle that reaches each pixel: (H, W)."""
    middle = middle_of(frame_shape)
    squared = _squared_distance(pixel_grid(frame_shape) - middle, middle)
    return (1 - lens.vignette * squared).astype(np.float32)


def middle_of(shape: tuple[float, float]) -> FloatArray:
    """Return the middle of an image of (height, width): (x, y)."""
    height, width = shape
    return np.array([(width - 1) / 2, (height - 1) / 2])


def _squared_distance(offsets: FloatArray, middle: FloatArray) -> FloatArray:
    """Return r^2 of (..., 2) offsets from the middle."""
    return np.asarray((offsets**2).sum(axis=-1) / (middle**2).sum())
