"""Read the poses of a run folder, and the true poses of a simulated capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError
from photonpano.geometry import Camera
from photonpano.reading import read_arrays
from photonpano.values import BoolArray, FloatArray

POSES = "poses.npz"
_ORTHONORMAL = 1e-3  # largest difference of R R^T from the identity in a pose


@dataclass(frozen=True, slots=True, eq=False)
class RunPoses:
    """Content of `poses.npz` in a run folder.

    Poses are (T, 3, 4), NaN where a frame is not located. The expected errors, (T,), are those in a world where the path has
    the length 1.
    """

    camera: Camera
    camera_from_world: FloatArray
    located: BoolArray
    std_position: FloatArray
    std_rotation_deg: FloatArray
    frame_shape: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class TruePoses:
    """True poses of a capture, (T, 3, 4) in m, and its focal length; None if it is not known."""

    camera_from_world: FloatArray
    focal_px: float | None = None


def has_poses(folder: Path) -> bool:
    """Return whether a run folder is that of a run with `pose`."""
    return (folder / POSES).exists()


def load_run_poses(folder: Path) -> RunPoses:
    """Read the poses of a run folder; `InputError` if the file is missing or damaged."""
    path = folder / POSES
    if not path.exists():
        raise InputError(f"{folder} has no {POSES}; give the folder of a finished run with `pose`")
    arrays = read_arrays(path, "the poses of a run")
    per_frame = ("located", "std_position", "std_rotation_deg")
    poses = _poses(path, arrays, ("camera_matrix", "distortion", "frame_shape", *per_frame))
    for name in per_frame:
        if arrays[name].shape != (len(poses),):
            raise InputError(f"{path}: {name} must have a number for each of {len(poses)} frames, got {arrays[name].shape}")
    located = arrays["located"].astype(bool)
    _require_rigid(path, poses[located])
    matrix, distortion = (arrays[name].astype(np.float64) for name in ("camera_matrix", "distortion"))
    if matrix.shape != (3, 3) or distortion.shape != (4,) or arrays["frame_shape"].shape != (2,):
        raise InputError(f"{path}: camera_matrix must be (3, 3), distortion (4,) and frame_shape (2,); run the spec again")
    height, width = (int(side) for side in arrays["frame_shape"])
    std_position, std_rotation_deg = (arrays[name].astype(np.float64) for name in per_frame[1:])
    return RunPoses(Camera(matrix, distortion), poses, located, std_position, std_rotation_deg, (height, width))


def load_true_poses(path: Path) -> TruePoses:
    """Read an `.npz` archive of `camera_from_world` (T, 3, 4) in m, and if it is known `camera_matrix` (3, 3).

    Raises `InputError` if the file is no such archive, or has no poses.
    """
    arrays = read_arrays(path, "a truth with poses")
    if "camera_from_world" not in arrays and "homographies" in arrays:
        raise InputError(
            f"{path} has homographies and no poses (camera_from_world): it is the truth of a flat scene, or of a camera that "
            "turns, and scores runs without `pose`"
        )
    poses = _poses(path, arrays)
    _require_rigid(path, poses)
    matrix = arrays.get("camera_matrix")
    return TruePoses(poses, None if matrix is None or matrix.shape != (3, 3) else float(matrix[0, 0]))


def _poses(path: Path, arrays: Mapping[str, NDArray[Any]], others: tuple[str, ...] = ()) -> FloatArray:
    missing = [name for name in ("camera_from_world", *others) if name not in arrays]
    if missing:
        held = ", ".join(name or "an array without a name" for name in arrays) or "nothing"
        raise InputError(f"{path} lacks {' and '.join(missing)}; it contains {held}")
    poses = arrays["camera_from_world"]
    if poses.ndim != 3 or poses.shape[1:] != (3, 4) or not len(poses) or poses.dtype.kind not in "fiu":
        raise InputError(f"{path}: camera_from_world must be numbers of the shape (frames, 3, 4), got {poses.shape}")
    return poses.astype(np.float64)


def _require_rigid(path: Path, poses: FloatArray) -> None:
    rotations = poses[:, :, :3]
    off = np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max(initial=0)
    if not np.isfinite(poses).all() or not off < _ORTHONORMAL or not (np.linalg.det(rotations) > 0).all():
        raise InputError(f"{path}: camera_from_world must be finite rotations and translations")
