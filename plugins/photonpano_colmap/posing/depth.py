"""The depth of a view, interpolated between points of the scene."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
from scipy.spatial import cKDTree

from photonpano import FloatArray

_STEP_PX = 8  # spacing of the grid on which depth is interpolated
_MARGIN = 0.05  # points up to this far outside of the frame are used, in its longer side
# A point is an outlier if its inverse depth differs from the median of its 7 neighbours by half of it.
_NEIGHBOURS = 7
_APART = 0.5
_LEAST = 4  # fewest points of a depth map


def inverse_depth_of(
    pose: FloatArray, points: FloatArray, camera_matrix: FloatArray, shape: tuple[int, int]
) -> NDArray[np.float32] | None:
    """Return the inverse depth of the pixels of a view, (H, W), from points of the world; None if it sees fewer than 4.

    It is linear between points, as that of a plane is. At the edges of things it is wrong by the width of a triangle; within a
    group, the camera moves so little that this hardly matters.
    """
    height, width = shape
    seen = points @ pose[:, :3].T + pose[:, 3]
    seen = seen[seen[:, 2] > 0]
    pixels = seen @ camera_matrix.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    margin = _MARGIN * max(shape)
    inside = ((pixels > -margin) & (pixels < (width + margin, height + margin))).all(axis=1)
    pixels, inverse_depth = pixels[inside], 1 / seen[inside, 2]
    if len(pixels) >= _NEIGHBOURS:
        _, nearest = cKDTree(pixels).query(pixels, k=_NEIGHBOURS)
        median = np.median(inverse_depth[nearest], axis=1)
        kept = np.abs(inverse_depth - median) < _APART * median
        pixels, inverse_depth = pixels[kept], inverse_depth[kept]
    if len(pixels) < _LEAST or np.linalg.matrix_rank(pixels - pixels.mean(axis=0), tol=1.0) < 2:
        return None
    rows, columns = -(-height // _STEP_PX), -(-width // _STEP_PX)
    middle = (_STEP_PX - 1) / 2
    x, y = np.meshgrid(np.arange(columns) * _STEP_PX + middle, np.arange(rows) * _STEP_PX + middle)
    grid = LinearNDInterpolator(pixels, inverse_depth)(x, y)
    grid = np.where(np.isfinite(grid), grid, NearestNDInterpolator(pixels, inverse_depth)(x, y)).astype(np.float32)
    fine = cv2.resize(grid, (columns * _STEP_PX, rows * _STEP_PX), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[:height, :width])
