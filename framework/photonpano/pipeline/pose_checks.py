"""Check what a pose estimator returns."""

from __future__ import annotations

import numpy as np

from photonpano.motion.attribution import BrokenContract, shown
from photonpano.values import BoolArray, FloatArray, PoseEstimate, StreamInfo

_ORTHONORMAL = 1e-6
"""Largest difference of R R^T from the identity."""
_RIGID = "must be a finite rotation and translation"


def require_estimate(estimate: object, stream: StreamInfo) -> PoseEstimate:
    """Return what a pose estimator returned, if its protocol allows it.

    Raises:
        BrokenContract: it does not; the message says what.
    """
    if not isinstance(estimate, PoseEstimate):
        raise BrokenContract(f"expected a PoseEstimate, got {shown(estimate)}")
    n_frames, located = stream.n_frames, np.asarray(estimate.located)
    if located.shape != (n_frames,) or located.dtype != np.bool_:
        raise BrokenContract(f"expected located as {n_frames} flags, got {shown(estimate.located)}")
    if not located.any():
        raise BrokenContract("no frame is located; raise a LocationError with the reason instead")
    poses = _array("camera_from_world", estimate.camera_from_world, (n_frames, 3, 4))
    if not np.isnan(poses[~located]).all():
        raise BrokenContract("camera_from_world must be NaN where a frame is not located")
    for frame in np.flatnonzero(located)[~_are_rigid(poses[located])].tolist():
        raise BrokenContract(f"the pose of frame {frame} {_RIGID}")
    for name in ("std_position", "std_rotation_deg"):
        std = _array(name, getattr(estimate, name), (n_frames,))
        if not (std[located] >= 0).all() or not np.isnan(std[~located]).all():
            raise BrokenContract(f"{name} must be 0 or more where a frame is located, inf if not known, and NaN elsewhere")
    matrix = _array("camera_matrix", estimate.camera_matrix, (3, 3))
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0 or matrix[2].tolist() != [0, 0, 1]:
        raise BrokenContract(f"camera_matrix must be finite with positive focal lengths, got {matrix.tolist()}")
    if not np.isfinite(_array("distortion", estimate.distortion, (4,))).all() or not estimate.std_focal_px >= 0:
        raise BrokenContract("distortion must be finite, and std_focal_px 0 or more")
    _require_scene(estimate, stream)
    return estimate


def _require_scene(estimate: PoseEstimate, stream: StreamInfo) -> None:
    """Check the points, the views, and the spans of lost frames."""
    count = len(estimate.points.positions)
    positions = _array("the positions of the points", estimate.points.positions, (count, 3))
    if not np.isfinite(positions).all() or np.shape(estimate.points.flux) != (count,):
        raise BrokenContract(f"expected finite positions of {count} points, and a flux for each")
    for view in estimate.views:
        where = f"the view of {view.span}"
        if view.span.stop > stream.n_frames or not view.span.start <= view.instant <= view.span.stop - 1:
            raise BrokenContract(f"{where} is seen from the instant {view.instant:g}, or reaches beyond the capture")
        if not _are_rigid(_array(f"the pose of {where}", view.camera_from_world, (3, 4))[None]).all():
            raise BrokenContract(f"the pose of {where} {_RIGID}")
        indices = np.asarray(view.points)
        if (
            indices.ndim != 1
            or indices.dtype.kind not in "iu"
            or (indices.size and not 0 <= indices.min() <= indices.max() < count)
        ):
            raise BrokenContract(f"{where} must show points 0 to {count - 1}, got {shown(view.points)}")
        if not np.isfinite(_array(f"xy of {where}", view.xy, (len(indices), 2))).all():
            raise BrokenContract(f"xy of {where} must be finite")
    lost = np.zeros(stream.n_frames, np.bool_)
    for each in estimate.lost:
        lost[each.span.start : each.span.stop] = True
    if unexplained := np.flatnonzero(~estimate.located & ~lost).tolist():
        raise BrokenContract(f"frame {unexplained[0]} is not located, and no entry of lost says why")


def _array(name: str, value: object, shape: tuple[int, ...]) -> FloatArray:
    if not isinstance(value, np.ndarray) or value.dtype != np.float64 or value.shape != shape:
        raise BrokenContract(f"expected {name} as float64 of the shape {shape}, got {shown(value)}")
    return value


def _are_rigid(poses: FloatArray) -> BoolArray:
    """Return which poses (N, 3, 4) are finite and made of a rotation and a translation: (N,)."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotations = np.where(finite[:, None, None], poses[:, :, :3], 0)
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(1, 2))
    rigid: BoolArray = finite & (off < _ORTHONORMAL) & (np.linalg.det(rotations) > 0)
    return rigid
