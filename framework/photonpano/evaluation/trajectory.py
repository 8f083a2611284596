"""Scores of a trajectory against the true motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import align_planes, corner_displacements
from photonpano.values import BoolArray, FloatArray, Homography


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryScore:
    """Corner errors of a trajectory after the best alignment of the two planes.

    The error of a frame is the mean, over its four corners, of the distance between the true and the estimated position, in
    pixels of the frame. Statistics are over the located frames.

    Attributes:
        errors_px: (T,) error of every frame, located or not.
        located: (T,) true for located frames.
        alignment: (3, 3), pixels of the estimated reference plane to pixels of the true plane.
        mean_px: mean error.
        median_px: median error.
        p95_px: 95 % quantile of the errors.
        max_px: largest error.
        located_share: share of the located frames, 0 to 1.
    """

    errors_px: FloatArray
    located: BoolArray
    alignment: Homography
    mean_px: float
    median_px: float
    p95_px: float
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

    Convention:
        Homographies map pixels of a frame to pixels of a plane; points are (x, y), integers are pixel centres.

    Args:
        estimated: (T, 3, 3), frame pixels to pixels of the estimated reference plane.
        true: (T, 3, 3), frame pixels to pixels of the true plane.
        frame_shape: (height, width) of a frame.
        located: (T,) the frames to compare, and to which the planes are aligned; all by default.
        start: (3, 3) near the alignment; needed where a camera turns too far for one plane.

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
