"""Scores of the motion of a run, and of its camera, against the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import Camera, align_planes, align_rotations, corner_displacements, rotation_vectors
from photonpano.values import BoolArray, FloatArray, Homography


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryScore:
    """Corner errors of a trajectory after the best alignment of the two planes.

    The error of a frame is the mean, over its four corners, of the distance between the true and the estimated position, in
    pixels of the frame. Statistics are over the located frames.
    """

    errors_px: FloatArray  # (T,) error of every frame, located or not
    located: BoolArray
    alignment: Homography  # (3, 3), pixels of the estimated reference plane to pixels of the true plane
    mean_px: float
    median_px: float
    p95_px: float  # 95 % quantile of the errors
    max_px: float
    located_share: float


def corner_errors(
    estimated: FloatArray,
    true: FloatArray,
    frame_shape: tuple[int, int],
    located: BoolArray | None = None,
    start: Homography | None = None,
) -> TrajectoryScore:
    """Score a trajectory against the true one.

    Convention: Homographies, (T, 3, 3), map pixels of a frame to pixels of a plane; points are (x, y), integers are pixel
    centres.

    Only `located` frames, (T,), are compared, and the planes aligned to them; by default all. Where a camera turns too far for
    one plane, the alignment needs a `start` near it.

    Raises:
        ValueError: the trajectories differ in length, or no frame is located.
    """
    counted = np.ones(len(true), dtype=bool) if located is None else np.asarray(located, dtype=bool)
    if not len(estimated) == len(true) == len(counted):
        raise ValueError(f"{len(estimated)} estimated and {len(true)} true homographies, {len(counted)} flags: give one each")
    alignment = align_planes(estimated[counted], true[counted], frame_shape, start)
    in_frame = np.linalg.inv(true) @ (alignment @ estimated)
    errors = corner_displacements(in_frame, np.eye(3), frame_shape).mean(axis=-1)
    compared = errors[counted]
    return TrajectoryScore(
        errors_px=errors,
        located=counted,
        alignment=alignment,
        mean_px=float(compared.mean()),
        median_px=float(np.median(compared)),
        p95_px=float(np.quantile(compared, 0.95)),
        max_px=float(compared.max()),
        located_share=float(counted.mean()),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The motion of a camera that only rotates: (T, 3, 3) rotations from the directions of frames to those of one camera."""

    rotations: FloatArray
    camera: Camera


def of_focal_length(relative_error: float, expected: float | None = None) -> str:
    """Write the error of a focal length in words: "5.20 % too short, where 4.00 % was expected"."""
    percent = 100 * relative_error
    if abs(percent) < 0.005:
        return "right within 0.01 %"
    error = f"{abs(percent):.2f} % too {'long' if percent > 0 else 'short'}"
    return f"{error}, where {100 * expected:.2f} % was expected" if expected else error


@dataclass(frozen=True, slots=True, eq=False)
class RotationScore:
    """Errors of rotations after the best common rotation, and of the focal length.

    Statistics are over the located frames. `errors_deg`, (T,), is the angle between the true and the estimated rotation of
    every frame. `focal_error` is relative, above 0 if the estimate is too long; `focal_std` is the relative error that the run
    expected, 0 of a focal length that was given, None if the run does not say.
    """

    errors_deg: FloatArray
    mean_deg: float
    max_deg: float
    focal_error: float
    focal_std: float | None = None


def rotation_errors(estimated: Turn, true: Turn, located: BoolArray) -> RotationScore:
    """Score the rotations of a run and its camera at the located frames, (T,)."""
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

    The true homographies are (T, 3, 3), ideal pixels of a frame to the true plane: P R K^-1 with the same P for all frames.
    """
    common = align_rotations(estimated.rotations[located], true.rotations[located])
    to_plane = true_homographies[0] @ true.camera.matrix @ true.rotations[0].T
    return np.asarray(to_plane @ common @ np.linalg.inv(estimated.camera.matrix))
