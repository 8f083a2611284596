"""The path of a camera through space: a pose for every frame.

Convention:
    A pose (3, 4) maps points of the world to points of the camera, X_c = R X_w + t: x right, y down, z ahead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from photonpano import FloatArray
from photonpano.geometry import rotation_matrices, rotation_vectors
from photonpano_colmap.pose_spline import positions_of


class Path:
    """The poses of all frames, interpolated between them."""

    def __init__(self, poses: FloatArray) -> None:
        """Take the (T, 3, 4) poses of at least two frames."""
        self.poses = poses
        self._centres = positions_of(poses)

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of M instants, in frames: (M, 3, 4). Before the first frame and after the last, the camera rests."""
        at = np.clip(np.atleast_1d(np.asarray(instants, dtype=np.float64)), 0, len(self.poses) - 1)
        first = np.minimum(at.astype(int), len(self.poses) - 2)
        share = (at - first)[:, None, None]
        rotations = (1 - share) * self.poses[first, :, :3] + share * self.poses[first + 1, :, :3]
        # A mean of two rotations is one that shrinks; a step of Newton's method undoes that.
        rotations = rotations @ (3 * np.eye(3) - np.swapaxes(rotations, 1, 2) @ rotations) / 2
        centres = (1 - share[:, 0]) * self._centres[first] + share[:, 0] * self._centres[first + 1]
        return posed(rotations, centres)

    def corrected(self, borders: FloatArray, means: FloatArray) -> Path:
        """Return this path, corrected where groups of frames were located along it.

        The frames of a group were merged along the path, so that where the group is located tells the mean correction of all of
        its frames, and not that of one instant. The correction is the smoothest function with these means, that of the least
        second derivative: the derivative of the natural quintic spline through its integral at the borders of the groups.

        Args:
            borders: (N + 1,) increasing, in frames: where groups begin and end, side by side.
            means: (N, 6) corrections of the groups, as `moves` has them.
        """
        integral = np.concatenate([np.zeros((1, 6)), np.cumsum(means * np.diff(borders)[:, None], axis=0)])
        end = [(3, np.zeros(6)), (4, np.zeros(6))]
        ends: Any = end, end  # which the library's types do not have
        correction = make_interp_spline(borders, integral, k=5, bc_type=ends).derivative()(np.arange(len(self.poses)))
        return Path(posed(rotation_matrices(correction[:, :3]) @ self.poses[:, :, :3], self._centres + correction[:, 3:]))

    def turned(self, turns: FloatArray) -> Path:
        """Return this path with the camera turned on the spot at each frame, by (T, 3) rotation vectors in its own axes."""
        return Path(rotation_matrices(turns) @ self.poses)


def posed(rotations: FloatArray, centres: FloatArray) -> FloatArray:
    """Return the poses of cameras with (N, 3, 3) rotations from the world, at (N, 3) places of the world: (N, 3, 4)."""
    shifts = -np.einsum("nij,nj->ni", rotations, centres)
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def moves(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return how poses differ, (N, 3, 4) each: rotation vectors of the camera, and shifts of its place in the world; (N, 6)."""
    turns = rotation_vectors(after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2))
    return np.concatenate([turns, positions_of(after) - positions_of(before)], axis=1)


def between(pose: FloatArray, other: FloatArray, camera_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the map from pixels of a view to those of another one, for points of known depth.

    A pixel (x, y) of inverse depth q is seen by the other camera at `turn @ (x, y, 1) + q * shift`, in homogeneous pixels.

    Args:
        pose: (3, 4) of the view.
        other: (..., 3, 4) of one or several others.
        camera_matrix: (3, 3) K of all.

    Returns:
        `turn`, (..., 3, 3), and `shift`, (..., 3).
    """
    rotation = other[..., :3] @ pose[:, :3].T
    moved = other[..., 3] - rotation @ pose[:, 3]
    return camera_matrix @ rotation @ np.linalg.inv(camera_matrix), moved @ camera_matrix.T


def projected(poses: FloatArray, points: FloatArray, camera_matrix: FloatArray) -> FloatArray:
    """Return where cameras see points of the world: (N, 3, 4) poses and (N, 3) points to (N, 2) px; NaN behind a camera."""
    seen = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
    depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    return np.asarray((seen @ camera_matrix.T)[:, :2] / depth)
