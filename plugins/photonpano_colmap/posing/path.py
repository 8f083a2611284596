"""The path of a camera through space, interpolated between located instants.

Convention:
    A pose (3, 4) maps points of the world to points of the camera, X_c = R X_w + t: x right, y down, z ahead.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from photonpano import FloatArray
from photonpano_colmap.pose_spline import positions_of

_DEGREE = 5
"""Degree of the spline through the integral of a correction."""


class Path(Protocol):
    """Poses of a camera at any instant."""

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of M instants, in frames: (M, 3, 4)."""
        ...


class CorrectedPath:
    """A path, corrected where groups of frames were located along it.

    The frames of a group were merged along the path, so that where the group is located tells the mean correction of all of its
    frames, and not that of one instant. The correction is the smooth function with these means: the derivative of a spline
    through its integral at the borders of the groups.
    """

    def __init__(self, path: Path, borders: FloatArray, instants: FloatArray, poses: FloatArray) -> None:
        """Correct a path.

        Args:
            path: along which the frames were merged.
            borders: (N + 1,) increasing, in frames: where groups begin and end, side by side.
            instants: (N,) reference instants of the groups.
            poses: (N, 3, 4) of these instants, as the groups were located.
        """
        self._path = path
        before = path.at(instants)
        turns = Rotation.from_matrix(poses[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2)).as_rotvec()
        steps = np.concatenate([turns, positions_of(poses) - positions_of(before)], axis=1)
        integral = np.concatenate([np.zeros((1, 6)), np.cumsum(steps * np.diff(borders)[:, None], axis=0)])
        self._correction = make_interp_spline(borders, integral, k=min(_DEGREE, 2 * (len(instants) // 2) - 1)).derivative()

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of M instants, in frames: (M, 3, 4)."""
        at = np.atleast_1d(np.asarray(instants, dtype=np.float64))
        before, correction = self._path.at(at), self._correction(at)
        turned = Rotation.from_rotvec(correction[:, :3]).as_matrix() @ before[:, :, :3]
        return posed(turned, positions_of(before) + correction[:, 3:])


def posed(rotations: FloatArray, centres: FloatArray) -> FloatArray:
    """Return the poses of cameras with (N, 3, 3) rotations from the world, at (N, 3) places of the world: (N, 3, 4)."""
    shifts = -np.einsum("nij,nj->ni", rotations, centres)
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def between(pose: FloatArray, other: FloatArray, camera_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the map from pixels of a view to those of another one, for points of known depth.

    A pixel (x, y) of inverse depth q is seen by the other camera at `turn @ (x, y, 1) + q * shift`, in homogeneous pixels.

    Args:
        pose: (3, 4) of the view.
        other: (3, 4) of the other one.
        camera_matrix: (3, 3) K of both.

    Returns:
        `turn`, (3, 3), and `shift`, (3,).
    """
    rotation = other[:, :3] @ pose[:, :3].T
    return camera_matrix @ rotation @ np.linalg.inv(camera_matrix), camera_matrix @ (other[:, 3] - rotation @ pose[:, 3])


def projected(poses: FloatArray, points: FloatArray, camera_matrix: FloatArray) -> FloatArray:
    """Return where cameras see points of the world: (N, 3, 4) poses and (N, 3) points to (N, 2) px; NaN behind a camera."""
    seen = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
    depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    return np.asarray((seen @ camera_matrix.T)[:, :2] / depth)
