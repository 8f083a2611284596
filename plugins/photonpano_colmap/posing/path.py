"""The path of a camera through space: a spline through some poses, or a pose for every frame.

Convention:
    A pose (3, 4) maps points of the world to points of the camera, X_c = R X_w + t: x right, y down, z ahead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation, RotationSpline

from photonpano import FloatArray
from photonpano.filtering import exceeding_noise
from photonpano.geometry import positions_of, rotation_matrices, rotation_vectors

_DEGREE = 5  # degree of the polynomial in time that is always kept: gauge and drift


class PoseSpline:
    """Cubic splines of positions and of rotations; beyond the first and the last pose the camera keeps its velocity.

    That of positions is a natural one: others magnify the noise of the outermost poses.
    """

    def __init__(self, instants: FloatArray, poses: FloatArray) -> None:
        """Fit (N, 3, 4) poses at increasing instants, in frames; N is at least 2."""
        self._ends = float(instants[0]), float(instants[-1])
        self._positions = CubicSpline(instants, positions_of(poses), bc_type="natural")
        self._rotations = RotationSpline(instants, Rotation.from_matrix(poses[:, :, :3]))

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the poses of N instants: (N, 3, 4)."""
        instants = np.asarray(instants, dtype=np.float64)
        inside = np.clip(instants, *self._ends)
        beyond = (instants - inside)[:, None]
        places = self._positions(inside) + beyond * self._positions(inside, 1)
        # Rates are those of the camera in the world, in its own axes.
        rotated = Rotation.from_rotvec(beyond * self._rotations(inside, 1))
        rotations = (self._rotations(inside) * rotated).as_matrix()
        return np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)


def left_out(instants: FloatArray, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return leave-one-out errors of the spline at inner poses: distances and angles in radians, (N - 2,) each."""
    apart, angles = [], []
    for place in range(1, len(instants) - 1):
        others = np.delete(np.arange(len(instants)), place)
        [predicted] = PoseSpline(instants[others], poses[others]).at(instants[place : place + 1])
        apart.append(float(np.linalg.norm(positions_of(predicted) - positions_of(poses[place]))))
        angles.append(float(Rotation.from_matrix(predicted[:, :3] @ poses[place, :, :3].T).magnitude()))
    return np.array(apart), np.array(angles)


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
        # The mean of two rotation matrices is not orthogonal; a step of Newton's method makes it so.
        rotations = rotations @ (3 * np.eye(3) - np.swapaxes(rotations, 1, 2) @ rotations) / 2
        centres = (1 - share[:, 0]) * self._centres[first] + share[:, 0] * self._centres[first + 1]
        return posed(rotations, centres)

    def corrected(self, borders: FloatArray, means: FloatArray) -> Path:
        """Return this path, corrected where groups of frames were located along it.

        The frames of a group were merged along the path, so a group's pose gives the mean correction of its frames, (N, 6), not
        that of one instant. Rotations are corrected by the function with these means and the least second derivative: the
        derivative of the natural quintic spline through its integral at the borders of the groups, (N + 1,) in frames.
        Positions become such a function: within a group they were interpolated only, from poses with more noise.
        """
        starts = np.ceil(borders).astype(int)
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(self._centres, axis=0)])[starts]
        centres = np.diff(sums, axis=0) / np.diff(starts)[:, None]
        means = np.concatenate([means[:, :3], centres + means[:, 3:]], axis=1)
        integral = np.concatenate([np.zeros((1, 6)), np.cumsum(means * np.diff(borders)[:, None], axis=0)])
        end = [(3, np.zeros(6)), (4, np.zeros(6))]
        ends: Any = end, end  # which the library's types do not have
        smooth = make_interp_spline(borders, integral, k=5, bc_type=ends).derivative()(np.arange(len(self.poses)))
        return Path(posed(rotation_matrices(smooth[:, :3]) @ self.poses[:, :, :3], smooth[:, 3:]))

    def rotated(self, rotations: FloatArray) -> Path:
        """Return this path with the camera rotated on the spot at each frame, by (T, 3) rotation vectors in its own axes."""
        return Path(rotation_matrices(rotations) @ self.poses)


def posed(rotations: FloatArray, centres: FloatArray) -> FloatArray:
    """Return the poses of cameras with (N, 3, 3) rotations from the world, at (N, 3) places of the world: (N, 3, 4)."""
    shifts = -np.einsum("nij,nj->ni", rotations, centres)
    return np.concatenate([rotations, shifts[:, :, None]], axis=2)


def moves(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return how poses differ, (N, 3, 4) each: rotation vectors of the camera, and shifts of its place in the world; (N, 6)."""
    rotations = rotation_vectors(after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2))
    return np.concatenate([rotations, positions_of(after) - positions_of(before)], axis=1)


def between(pose: FloatArray, other: FloatArray, camera_matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `turn`, (..., 3, 3), and `shift`, (..., 3): the map of pixels of a view to those of other poses, (..., 3, 4).

    A pixel (x, y) of inverse depth q is seen by the other camera at `turn @ (x, y, 1) + q * shift`, in homogeneous pixels.
    """
    rotation = other[..., :3] @ pose[:, :3].T
    moved = other[..., 3] - rotation @ pose[:, 3]
    return camera_matrix @ rotation @ np.linalg.inv(camera_matrix), moved @ camera_matrix.T


def projected(poses: FloatArray, points: FloatArray, camera_matrix: FloatArray) -> FloatArray:
    """Return where cameras see points of the world: (N, 3, 4) poses and (N, 3) points to (N, 2) px; NaN behind a camera."""
    seen = np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
    depth = np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    return np.asarray((seen @ camera_matrix.T)[:, :2] / depth)


def exceeding_noise_of_poses(moves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Denoise (N, 6) corrections of poses, in px, with a Wiener filter, and keep their slow part; `covariance` is (N, 6, 6)."""
    times = np.linspace(-1, 1, len(moves))
    basis = np.polynomial.legendre.legvander(times, min(_DEGREE, len(moves) - 1))
    slow = basis @ np.linalg.lstsq(basis, moves, rcond=None)[0]
    # In these modes, errors are independent of each other.
    _, modes = np.linalg.eigh(np.linalg.inv(covariance).mean(axis=0))
    variances = np.einsum("ka,nkl,la->na", modes, covariance, modes)
    rest = [exceeding_noise(*columns).signal for columns in zip(((moves - slow) @ modes).T, variances.T, strict=True)]
    return np.asarray(slow + np.stack(rest, axis=1) @ modes.T)
