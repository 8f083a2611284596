"""Expected errors of poses from bundle adjustment: the covariance of cameras with origin, axes and scale aligned.

Convention:
    X_c = R (X - c) for the position c of a camera. A pose is perturbed by a rotation vector of its camera, exp(w) R, and by a
    shift of c in the world. K maps points of the camera to ideal pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.geometry import positions_of

_POSE = 6  # unknowns of a pose: rotation vector and position
_SMALLEST = 1e-12  # eigenvalues of the information below this fraction of the largest are undetermined directions


@dataclass(frozen=True, slots=True, eq=False)
class PoseNoise:
    """Expected errors, root mean square."""

    std_position: FloatArray  # (N,) in units of the world
    std_rotation: FloatArray  # (N,) in radians
    std_focal_px: float  # 0 if the focal length is known
    residual_px: float  # root mean square of the residuals along x and y


def pose_noise(
    poses: FloatArray,
    points: FloatArray,
    observed: Sequence[tuple[NDArray[np.intp], FloatArray]],
    matrix: FloatArray,
    finds_focal: bool,
) -> PoseNoise:
    """Return the expected errors of (N, 3, 4) poses after the best alignment of positions with the true ones.

    The points, (M, 3), are eliminated (Schur complement), and the seven directions of the gauge are projected out of the
    covariance, as a similarity that aligns the positions does. The noise in an image is that of the residuals. `observed` are
    for each pose the indices of K points, and their (K, 2) ideal pixels.
    """
    n_poses, size = len(poses), _POSE * len(poses) + finds_focal
    information = np.zeros((size, size))
    corners: list[dict[int, FloatArray]] = [{} for _ in points]
    of_points = np.zeros((len(points), 3, 3))
    squares, count = 0.0, 0
    for place, (pose, (indices, xy)) in enumerate(zip(poses, observed, strict=True)):
        residuals, by_camera, by_point = _linearised(pose, points[indices], xy, matrix, finds_focal)
        squares, count = squares + float((residuals**2).sum()), count + residuals.size
        own = np.r_[_POSE * place : _POSE * place + _POSE, *([size - 1] if finds_focal else [])]
        information[np.ix_(own, own)] += np.einsum("kia,kib->ab", by_camera, by_camera)
        np.add.at(of_points, indices, np.einsum("kia,kib->kab", by_point, by_point))
        for index, cross in zip(indices.tolist(), np.einsum("kia,kib->kab", by_camera, by_point), strict=True):
            corners[index][place] = cross
    for index, cross_of in enumerate(corners):
        if len(cross_of) < 2:
            continue
        own = np.concatenate([np.arange(_POSE * place, _POSE * place + _POSE) for place in cross_of])
        cross = np.concatenate([each[:_POSE] for each in cross_of.values()])
        if finds_focal:
            own, cross = np.append(own, size - 1), np.concatenate([cross, sum(each[_POSE:] for each in cross_of.values())])
        information[np.ix_(own, own)] -= cross @ np.linalg.pinv(of_points[index]) @ cross.T
    freedom = max(1, count - size - 3 * len(points) + 7)
    covariance = squares / freedom * without_gauge(information, poses)
    variances = np.diag(covariance)
    per_pose = variances[: _POSE * n_poses].reshape(n_poses, 2, 3).sum(axis=2)
    return PoseNoise(
        np.sqrt(per_pose[:, 1]),
        np.sqrt(per_pose[:, 0]),
        float(np.sqrt(variances[-1])) if finds_focal else 0.0,
        float(np.sqrt(squares / max(1, count))),
    )


def _linearised(
    pose: FloatArray, points: FloatArray, xy: FloatArray, matrix: FloatArray, finds_focal: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (K, 2) and their derivatives by the camera (K, 2, 6 or 7) and by the point (K, 2, 3)."""
    rotation, focal = pose[:, :3], np.diag(matrix)[:2]
    seen = points @ rotation.T + pose[:, 3]
    ahead = seen[:, 2:]
    plane = seen[:, :2] / ahead
    residuals = plane * focal + matrix[:2, 2] - xy
    by_seen = np.zeros((len(points), 2, 3))
    by_seen[:, 0, 0], by_seen[:, 1, 1] = focal[0] / ahead[:, 0], focal[1] / ahead[:, 0]
    by_seen[:, :, 2] = -focal * plane / ahead
    turned = np.cross(np.eye(3)[None], seen[:, None, :])  # row a: derivative of the point by rotation about axis a
    by_camera = np.concatenate([by_seen @ np.swapaxes(turned, 1, 2), -by_seen @ rotation], axis=2)
    if finds_focal:
        by_camera = np.concatenate([by_camera, plane[:, :, None]], axis=2)
    return residuals, by_camera, by_seen @ rotation


def without_gauge(information: FloatArray, poses: FloatArray) -> FloatArray:
    """Invert (6 N, 6 N) information, or with one more unknown, and project the covariance as aligning the positions does."""
    values, vectors = np.linalg.eigh(information)
    inverted = np.where(values > _SMALLEST * values[-1], 1 / np.where(values > 0, values, 1), 0)
    covariance = (vectors * inverted) @ vectors.T
    rotations = poses[:, :, :3]
    places = positions_of(poses)
    gauge = np.zeros((len(information), 7))
    for place, (rotation, position) in enumerate(zip(rotations, places - places.mean(axis=0), strict=True)):
        rows = slice(_POSE * place, _POSE * place + 3), slice(_POSE * place + 3, _POSE * place + _POSE)
        gauge[rows[1], :3] = np.eye(3)
        gauge[rows[1], 3:6] = np.cross(np.eye(3), position).T
        gauge[rows[0], 3:6] = -rotation
        gauge[rows[1], 6] = position
    of_positions = np.zeros(len(information), np.bool_)
    for axis in range(3, _POSE):
        of_positions[axis : _POSE * len(poses) : _POSE] = True
    aligned = np.eye(len(information))
    aligned[:, of_positions] -= gauge @ np.linalg.pinv(gauge[of_positions])
    return np.asarray(aligned @ covariance @ aligned.T)
