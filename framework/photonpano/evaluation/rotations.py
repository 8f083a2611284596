"""Scores of the rotations and the camera of a run against those of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import Camera, align_rotations, rotation_vectors
from photonpano.values import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The motion of a camera that only turns.

    Attributes:
        rotations: (T, 3, 3), directions of each frame's camera to those of one camera.
        camera: of all frames.
    """

    rotations: FloatArray
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class RotationScore:
    """Errors of rotations after the best common rotation, and of the focal length.

    Statistics are over the located frames.

    Attributes:
        errors_deg: (T,) angle between the true and the estimated rotation of every frame, located or not.
        mean_deg: mean error.
        max_deg: largest error.
        focal_error: error of the focal length, relative to the true one; above 0 if the estimate is too long.
    """

    errors_deg: FloatArray
    mean_deg: float
    max_deg: float
    focal_error: float


def rotation_errors(estimated: Turn, true: Turn, located: BoolArray) -> RotationScore:
    """Score the rotations of a run and its camera.

    Args:
        estimated: found by the run, T frames.
        true: of the same frames.
        located: (T,) the frames to compare.
    """
    common = align_rotations(estimated.rotations[located], true.rotations[located])
    between = np.swapaxes(true.rotations, -1, -2) @ common @ estimated.rotations
    errors_deg = np.rad2deg(np.linalg.norm(rotation_vectors(between), axis=-1))
    return RotationScore(
        errors_deg=errors_deg,
        mean_deg=float(errors_deg[located].mean()),
        max_deg=float(errors_deg[located].max()),
        focal_error=estimated.camera.focal_px / true.camera.focal_px - 1,
    )


def turned_alignment(estimated: Turn, true: Turn, true_homographies: FloatArray, located: BoolArray) -> FloatArray:
    """Return about which homography maps the reference plane of a run to the true plane: (3, 3), of positive determinant.

    Args:
        estimated: found by the run, T frames.
        true: of the same frames.
        true_homographies: (T, 3, 3), ideal pixels of a frame to the true plane: P R K^-1 with the same P for all frames.
        located: (T,) the frames to compare.
    """
    common = align_rotations(estimated.rotations[located], true.rotations[located])
    to_plane = true_homographies[0] @ true.camera.matrix @ true.rotations[0].T
    return np.asarray(to_plane @ common @ np.linalg.inv(estimated.camera.matrix))
