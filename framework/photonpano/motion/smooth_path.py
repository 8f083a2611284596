"""A smooth path of the camera: the view of each instant without its tremor."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano.geometry import corners, nearest_rotations, normalised, rotation_matrices, rotation_vectors
from photonpano.motion.frame_motion import FrameMotion
from photonpano.values import FloatArray, FrameSpan, Homography

_REACH = 3.0  # instants up to this many standard deviations away count
_MOST_INSTANTS = 400
_NEAR = 0.5  # a frame counts if its corners have more than this part of the depth of the instant's; others look elsewhere


def smooth_view(motion: FrameMotion, instant: float, std: float) -> Homography:
    """Return where a camera without tremor would look from: (3, 3), pixels of a view as large as a frame to reference pixels.

    The motions between the frame of the instant and those around it are smoothed by lines of least squares with Gaussian
    weights of the given standard deviation in frames, so that a camera that pans evenly is followed without lag, also at the
    ends of the span. Smoothed are the rotation vectors of a camera that turns, and the places of the corners of any other.
    """
    here: Homography = motion.trajectory.at([instant])[0]
    frame, instants = corners(motion.frame_shape), _instants(instant, motion.span, std)
    relative = np.linalg.inv(here) @ motion.trajectory.at(instants)
    # A common factor is the scale of the matrices; the frame of the instant has depth 1.
    points = np.concatenate([frame, np.ones((4, 1))], axis=1) @ np.swapaxes(relative, 1, 2)
    near = (points[..., 2] > _NEAR).all(axis=1)
    share = _at_zero(instants[near] - instant, std)
    if share is None:
        return here
    if motion.camera is not None:
        vector = share @ rotation_vectors(nearest_rotations(motion.camera.rotations(relative[near])))
        return np.asarray(here @ motion.camera.homographies(rotation_matrices(vector)))
    smooth = np.tensordot(share, points[near, :, :2] / points[near, :, 2:], axes=1)
    to_frame = cv2.getPerspectiveTransform(frame.astype(np.float32), smooth.astype(np.float32))
    return np.asarray(here @ normalised(to_frame))


def _instants(instant: float, span: FrameSpan, std: float) -> FloatArray:
    first, last = max(instant - _REACH * std, span.start), min(instant + _REACH * std, span.stop - 1)
    number = min(int(last - first) + 1, _MOST_INSTANTS)
    return np.unique(np.linspace(first, last, max(number, 1)).round())


def _at_zero(times: FloatArray, std: float) -> FloatArray | None:
    """Return the weights, of sum 1, that give a line of least squares at time 0; None for fewer than two times."""
    weights = np.exp(-0.5 * (times / std) ** 2)
    sum_0, sum_1, sum_2 = (float((weights * times**power).sum()) for power in range(3))
    determinant = sum_0 * sum_2 - sum_1**2
    if len(times) < 2 or determinant <= 1e-9 * sum_0**2:
        return None
    return np.asarray(weights * (sum_2 - sum_1 * times) / determinant)
