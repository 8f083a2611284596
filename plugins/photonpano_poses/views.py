"""How cameras with known poses see each other's pixels, through their lens.

Convention:
    A pose (3, 4) maps points of the world to points of the camera, X_c = R X_w + t: x right, y down, z ahead.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano.geometry import Camera


class Lens(NamedTuple):
    """Where a lens images what ideal pixels see: see `photonpano.geometry.Camera`."""

    distorts: bool
    focal: float
    centre: tuple[float, float]
    distortion: tuple[float, float, float, float]
    limit: float  # squared radius in focal lengths beyond which a frame shows nothing
    ideal: FloatArray  # (H, W, 2) ideal pixels of the pixels of a frame; NaN where none is imaged
    slopes: FloatArray  # (H, W, 2, 2) derivatives of the pixels of a frame by ideal ones


@lru_cache(maxsize=4)
def lens_of(camera: Camera, frame_shape: tuple[int, int]) -> Lens:
    """Return the lens of a camera, for frames of (height, width)."""
    height, width = frame_shape
    ideal: FloatArray = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    slopes: FloatArray = np.broadcast_to(np.eye(2), (height, width, 2, 2))
    limit = np.inf
    if camera.distorts:
        ideal = camera.ideal(ideal)
        sides = [camera.distorted(ideal + step) - camera.distorted(ideal - step) for step in np.eye(2) / 2]
        slopes = np.stack(sides, axis=-1)
        limit = float(np.nanmax((((ideal - camera.centre_px) / camera.focal_px) ** 2).sum(axis=-1)))
    k1, k2, p1, p2 = camera.distortion.tolist()
    return Lens(camera.distorts, camera.focal_px, camera.centre_px, (k1, k2, p1, p2), limit, ideal, np.array(slopes))


@compiled
def imaged(lens: Lens, x: float, y: float) -> tuple[float, float]:
    """Return the pixel of a frame that images what an ideal pixel sees; NaN if none does."""
    if not lens.distorts:
        return x, y
    k1, k2, p1, p2 = lens.distortion
    a, b = (x - lens.centre[0]) / lens.focal, (y - lens.centre[1]) / lens.focal
    square = a * a + b * b
    if not square <= lens.limit:
        return np.nan, np.nan
    radial = 1 + square * (k1 + k2 * square)
    across = a * radial + 2 * p1 * a * b + p2 * (square + 2 * a * a)
    down = b * radial + p1 * (square + 2 * b * b) + 2 * p2 * a * b
    return lens.focal * across + lens.centre[0], lens.focal * down + lens.centre[1]


@compiled
def seen_at(  # noqa: PLR0917
    lens: Lens, turn: FloatArray, shift: FloatArray, x: float, y: float, inverse_depth: float
) -> tuple[float, float, float]:
    """Return the pixel of another view that sees what an ideal pixel sees, NaN if none does, and how deep that lies there.

    `turn` and `shift` are those of `between`. The depth there is relative to the depth here.
    """
    depth = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] + inverse_depth * shift[2]
    if not depth > 0:
        return np.nan, np.nan, depth
    across = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] + inverse_depth * shift[0]
    down = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] + inverse_depth * shift[1]
    u, v = imaged(lens, across / depth, down / depth)
    return u, v, depth


@compiled
def sampled(image: NDArray[np.float32], x: float, y: float) -> float:
    """Return an image at a place, interpolated bilinearly; NaN outside."""
    height, width = image.shape
    if not (0 <= x < width - 1 and 0 <= y < height - 1):
        return np.nan
    i, j = int(x), int(y)
    a, b = x - i, y - j
    upper = (1 - a) * image[j, i] + a * image[j, i + 1]
    return float((1 - b) * upper + b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1]))


def between(pose: FloatArray, other: FloatArray, camera_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `turn`, (..., 3, 3), and `shift`, (..., 3): the map of pixels of a view to those of other poses, (..., 3, 4).

    A pixel (x, y) of inverse depth q is seen by the other camera at `turn @ (x, y, 1) + q * shift`, in homogeneous pixels.
    """
    rotation = other[..., :3] @ pose[:, :3].T
    moved = other[..., 3] - rotation @ pose[:, 3]
    return camera_matrix @ rotation @ np.linalg.inv(camera_matrix), moved @ camera_matrix.T
