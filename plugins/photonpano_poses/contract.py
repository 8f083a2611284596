"""The contract of pose estimators: what they are told and find, their interface, the record that offers one, and the rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, FluxImage, FrameSpan, Progress, Reason, Source, StageContext
from photonpano.contracts.requirements import BrokenContract, require_array, require_finite, require_instance, shown
from photonpano.plugins.contributions import StageContribution


@dataclass(frozen=True, slots=True)
class CameraGuess:
    """What is known of a camera before its poses are estimated."""

    focal_px: float | None = None  # focal length in px of a frame; None if it is to be found
    # (x, y) of the principal point, in px of a frame, integers are pixel centres; None for the middle of a frame
    centre_px: tuple[float, float] | None = None
    # k1, k2, p1, p2 of the lens as OpenCV defines them, which are known
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ScenePoints:
    """Points of the scene."""

    positions: FloatArray  # (N, 3) float64, in the world
    flux: NDArray[np.float32]  # (N,) float32, photons per pixel per frame where exposures show them; NaN where it is not known


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A virtual exposure whose pose was found from the points that it shows."""

    span: FrameSpan  # the frames that were merged
    instant: float  # the instant from which it is seen, in frames
    camera_from_world: FloatArray  # (3, 4), its pose
    points: NDArray[np.intp]  # (K,) indices of the points that were found in it
    xy: FloatArray  # (K, 2) where these were found, in px of a frame with its distortion; integers are pixel centres
    # returns the exposure, (H, W) float32, photons per pixel per frame, NaN where unknown. It may read the capture
    flux: Callable[[], FluxImage]


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """The depth of the pixels of an exposure, found from the other exposures alone."""

    view: int  # number of the exposure among the views
    inverse_depth: NDArray[np.float32]  # (H, W) float32, one over the depth along the optical axis; NaN where it is not known
    std: NDArray[np.float32]  # (H, W) float32, its expected error; NaN where it is not known
    flux: FluxImage  # (H, W) float32, flux of the other exposures at this depth, photons per pixel per frame
    flux_nearer: FluxImage  # (H, W) float32, the same for an inverse depth that is larger by 3 std
    flux_farther: FluxImage  # (H, W) float32, the same for one that is smaller by 3 std


@dataclass(frozen=True, slots=True)
class LostFrames:
    """Frames whose pose was not found."""

    span: FrameSpan  # the frames
    reason: str  # a clause that completes "not located: ...", with the numbers that decided


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """The pose of every frame, and the points that the camera has seen.

    Convention:
        Points of the world are (x, y, z): x right, y down, z ahead. A pose (3, 4) maps them to points of the camera,
        X_c = R X_w + t, with the same axes; ideal pixels are K X_c, integers are pixel centres. The scale and the origin of
        the world are free: a run moves them, so that the first located camera is the origin and looks along z, and so
        that the path of the located cameras has the length 1.
    """

    camera_matrix: FloatArray  # (3, 3) K, in px of a frame
    distortion: FloatArray  # (4,) k1, k2, p1, p2 as OpenCV defines them
    std_focal_px: float  # expected error of the focal length; 0 if it was given, inf if it is not known
    camera_from_world: FloatArray  # (T, 3, 4) float64; NaN where a frame is not located, never an identity
    located: BoolArray  # (T,) whether the pose of a frame was found
    # (T,) expected distance of the camera from its true place, root mean square, in units of the world; NaN where not located,
    # inf where it is not known
    std_position: FloatArray
    # (T,) expected angle between the found and the true rotation, root mean square, in degrees; NaN where not located, inf
    # where it is not known
    std_rotation_deg: FloatArray
    points: ScenePoints  # of the scene
    views: tuple[PosedView, ...] = ()  # the exposures whose poses were found, in order of their instants
    lost: tuple[LostFrames, ...] = ()  # the frames that are not located, with reasons
    levels: tuple[Mapping[str, float | int | str | None], ...] = ()  # a record for each level: numbers and texts by name
    doubts: tuple[Reason, ...] = ()  # why the poses may be wrong, as far as the estimator can tell; empty if it trusts them
    depth: tuple[DepthMap, ...] = ()  # of some views; empty if it was not asked for
    # median distance of the points from where the views show them, in units of what photon noise explains; None if that is not
    # known
    residual_ratio: float | None = None


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
    if (bent := np.flatnonzero(located)[~are_rigid(poses[located])]).size:
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
    for depth in found.depth:
        _require_depth(depth, len(found.views), source.info.frame_shape)
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
    if not are_rigid(view.camera_from_world[None]).all():
        raise BrokenContract(f"the pose of {of} must be a rotation and translation")
    indices = np.asarray(view.points)
    if indices.dtype.kind not in "iu" or ((indices < 0) | (indices >= n_points)).any():
        raise BrokenContract(f"{of} must show points 0 to {n_points - 1}, got {shown(view.points)}")
    require_finite(f"xy of {of}", view.xy, (len(indices), 2))


def _require_depth(depth: DepthMap, n_views: int, frame_shape: tuple[int, int]) -> None:
    require_instance(depth, DepthMap)
    if not 0 <= depth.view < n_views:
        raise BrokenContract(f"a depth map is that of the view {depth.view}, and there are {n_views}")
    for name in ("inverse_depth", "std", "flux", "flux_nearer", "flux_farther"):
        require_array(f"{name} of a depth map", getattr(depth, name), frame_shape, "float32")
    known = np.isfinite(depth.inverse_depth)
    if not ((depth.inverse_depth[known] > 0).all() and (depth.std[known] >= 0).all()):
        raise BrokenContract("the inverse depth of a depth map must be above 0, and its std 0 or more; NaN where not known")


def are_rigid(poses: FloatArray, tolerance: float = 1e-6) -> BoolArray:
    """Return which poses (N, 3, 4) are finite, a translation and a rotation up to the largest element of R R^T - I: (N,)."""
    finite = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    rotations = np.where(finite[:, None, None], poses[:, :, :3], 0)
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(axis=(1, 2))
    rigid: BoolArray = finite & (off < tolerance) & (np.linalg.det(rotations) > 0)
    return rigid
