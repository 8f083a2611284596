"""The contract of pose estimators: their interface, the record that offers one, and what they may return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from photonpano import BoolArray, FloatArray, Progress, Reason, Source, StageContext
from photonpano.contracts.requirements import BrokenContract, require_array, require_finite, require_instance, shown
from photonpano.plugins.contributions import StageContribution
from photonpano_poses.values import CameraGuess, PosedView, PoseEstimate

_ORTHONORMAL = 1e-6  # largest element of R R^T - I of a rotation


class PoseEstimator(Protocol):
    """Estimates where a camera was in each frame, in six degrees of freedom (paper, section 6). Experimental."""

    def estimate(self, source: Source, camera: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses of a capture.

        A run refuses an estimate with poses for frames that are not located, or without poses for those that are.

        Args:
            source: the capture.
            camera: what the spec says about it; what it gives stays as it is.
            progress: receives stages and messages.

        Raises:
            LocationError: there are no poses to be found; the message says why, with numbers, and what to do.
        """


@dataclass(frozen=True, kw_only=True)
class PoseEstimatorContribution(
    StageContribution,
    kind="pose-estimator",
    section="pose",
    meaning="instead of a panorama, the pose of each frame of a camera that travels through a scene: a name, or {use, with}. "
    "The sections of the panorama do not apply then. Experimental",
):
    """Offers a pose estimator. Experimental: the record may change with any version."""

    build: Callable[[Any, StageContext], PoseEstimator]


def require_poses(found: Any, source: Source) -> PoseEstimate:
    """Return the estimate of a pose estimator; `BrokenContract` if a run refuses it."""
    require_instance(found, PoseEstimate)
    n_frames, located = source.info.n_frames, found.located
    require_array("located", located, (n_frames,), "bool", "b")
    if not located.any():
        raise BrokenContract("no frame is located; raise a LocationError with the reason instead")
    poses = found.camera_from_world
    require_array("camera_from_world", poses, (n_frames, 3, 4), "float64")
    if not np.isnan(poses[~located]).all():
        raise BrokenContract("camera_from_world must be NaN where a frame is not located")
    if (bent := np.flatnonzero(located)[~_are_rigid(poses[located])]).size:
        raise BrokenContract(f"the pose of frame {bent[0]} must be a finite rotation and translation")
    for name in ("std_position", "std_rotation_deg"):
        std = getattr(found, name)
        require_array(name, std, (n_frames,), "float64")
        if not ((std[located] >= 0).all() and np.isnan(std[~located]).all()):
            raise BrokenContract(f"{name} must be 0 or more where a frame is located, inf if not known, and NaN elsewhere")
    _require_camera(found)
    n_points = len(found.points.positions)
    require_finite("points.positions", found.points.positions, (n_points, 3))
    if np.shape(found.points.flux) != (n_points,):
        raise BrokenContract(f"expected a flux for each of {n_points} points")
    for view in found.views:
        _require_view(view, n_points, n_frames)
    explained = located.copy()
    for each in found.lost:
        explained[each.span.start : each.span.stop] = True
    if not explained.all():
        raise BrokenContract(f"frame {np.argmin(explained)} is not located, and no entry of lost says why")
    for doubt in found.doubts:
        require_instance(doubt, Reason)
    estimate: PoseEstimate = found
    return estimate


def _require_camera(found: PoseEstimate) -> None:
    matrix = found.camera_matrix
    require_finite("camera_matrix", matrix, (3, 3))
    if not (min(matrix[0, 0], matrix[1, 1]) > 0 and matrix[2].tolist() == [0, 0, 1]):
        raise BrokenContract(f"camera_matrix must have positive focal lengths, got {matrix.tolist()}")
    require_finite("distortion", found.distortion, (4,))
    if not found.std_focal_px >= 0:
        raise BrokenContract(f"std_focal_px must be 0 or more, got {found.std_focal_px!r}")


def _require_view(view: PosedView, n_points: int, n_frames: int) -> None:
    of = f"the view of {view.span}"
    if view.span.stop > n_frames or not view.span.start <= view.instant <= view.span.stop - 1:
        raise BrokenContract(f"{of} is seen from the instant {view.instant:g}, or reaches beyond the capture")
    require_finite(f"the pose of {of}", view.camera_from_world, (3, 4))
    if not _are_rigid(view.camera_from_world[None]).all():
        raise BrokenContract(f"the pose of {of} must be a rotation and translation")
    indices = np.asarray(view.points)
    if indices.dtype.kind not in "iu" or ((indices < 0) | (indices >= n_points)).any():
        raise BrokenContract(f"{of} must show points 0 to {n_points - 1}, got {shown(view.points)}")
    require_finite(f"xy of {of}", view.xy, (len(indices), 2))


def _are_rigid(poses: FloatArray) -> BoolArray:
    """Return which poses (N, 3, 4) are finite and made of a rotation and a translation: (N,)."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotations = np.where(finite[:, None, None], poses[:, :, :3], 0)
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(1, 2))
    rigid: BoolArray = finite & (off < _ORTHONORMAL) & (np.linalg.det(rotations) > 0)
    return rigid
