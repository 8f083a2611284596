"""A spline through poses: the position and the rotation of a camera at any instant.

Convention:
    Poses (3, 4) map points of the world to points of the camera, X_c = R X_w + t. Beyond the first and the last instant the
    camera keeps its velocity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from photonpano import FloatArray


class PoseSpline:
    """Cubic splines of positions and of rotations, both with continuous acceleration."""

    def __init__(self, instants: FloatArray, poses: FloatArray) -> None:
        """Fit (N, 3, 4) poses at increasing instants, in frames; N is at least 2."""
        self._ends = float(instants[0]), float(instants[-1])
        self._positions = CubicSpline(instants, positions_of(poses))
        self._rotations = RotationSpline(instants, Rotation.from_matrix(poses[:, :, :3]))

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of N instants: (N, 3, 4)."""
        instants = np.asarray(instants, dtype=np.float64)
        inside = np.clip(instants, *self._ends)
        beyond = (instants - inside)[:, None]
        places = self._positions(inside) + beyond * self._positions(inside, 1)
        # Rates are those of the camera in the world, in its own axes.
        turned = Rotation.from_rotvec(beyond * self._rotations(inside, 1))
        rotations = (self._rotations(inside) * turned).as_matrix()
        return np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)


def left_out(instants: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far each inner pose is from the spline through the others: distances and angles in radians, (N - 2,) each."""
    apart, angles = [], []
    for place in range(1, len(instants) - 1):
        others = np.delete(np.arange(len(instants)), place)
        [predicted] = PoseSpline(instants[others], poses[others]).at(instants[place : place + 1])
        apart.append(float(np.linalg.norm(positions_of(predicted) - positions_of(poses[place]))))
        angles.append(float(Rotation.from_matrix(predicted[:, :3] @ poses[place, :, :3].T).magnitude()))
    return np.array(apart), np.array(angles)


def positions_of(poses: FloatArray) -> FloatArray:
    """Return the positions of cameras in the world, -R^T t: (..., 3, 4) to (..., 3)."""
    return np.asarray(-np.einsum("...ji,...j->...i", poses[..., :3], poses[..., 3]))
