"""Rotations and rotation vectors.

Convention:
    A rotation is (3, 3) with determinant 1 and maps column vectors; its rotation vector points along the axis, and its length
    is the angle in radians. All functions take stacks as well.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from photonpano.geometry.homographies import BLOCK_FRAMES
from photonpano.values import FloatArray

# Derivatives of a small rotation by its rotation vector: (3, 3, 3).
ROTATION_AXES = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)
ROTATION_AXES.flags.writeable = False


def rotation_matrices(vectors: ArrayLike) -> FloatArray:
    """Return the rotations of rotation vectors: (..., 3) to (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    vectors = np.asarray(vectors, dtype=np.float64)
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()).reshape(*vectors.shape, 3)


def rotation_vectors(rotations: ArrayLike) -> FloatArray:
    """Return the rotation vectors of rotations, of angles up to pi: (..., 3, 3) to (..., 3)."""
    from scipy.spatial.transform import Rotation

    rotations = np.asarray(rotations, dtype=np.float64)
    return np.asarray(Rotation.from_matrix(rotations.reshape(-1, 3, 3)).as_rotvec()).reshape(rotations.shape[:-1])


def nearest_rotations(matrices: ArrayLike) -> FloatArray:
    """Return the rotations nearest to (..., 3, 3) matrices of positive determinant, whatever their scale (Kabsch 1976)."""
    given = np.asarray(matrices, dtype=np.float64)
    flat, found = given.reshape(-1, 3, 3), np.empty(given.shape)
    for start in range(0, len(flat), BLOCK_FRAMES):
        left, _, right = np.linalg.svd(flat[start : start + BLOCK_FRAMES])
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        found.reshape(-1, 3, 3)[start : start + BLOCK_FRAMES] = left @ right
    return found
