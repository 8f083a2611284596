"""The motion of every frame of a capture, as the loop leaves it; and a smooth path of the camera, without its tremor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from photonpano.contracts.protocols import Source, Trajectory, camera_of, camera_of_motion
from photonpano.geometry import (
    BLOCK_FRAMES,
    Camera,
    FrameTrajectory,
    corners,
    nearest_rotations,
    normalised,
    rotation_matrices,
    rotation_vectors,
)
from photonpano.merging.panorama import View
from photonpano.motion.loop import LevelResult
from photonpano.values import BoolArray, FloatArray, FrameSpan, Homography, StreamInfo

_REACH = 3.0  # instants up to this many standard deviations away count
_MOST_INSTANTS = 400
_NEAR = 0.5  # a frame counts if its corners have more than this part of the depth of the instant's; others look elsewhere


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class FrameMotion:
    """The motion of T frames.

    Convention:
        Homographies map frame pixels to reference pixels; points are (x, y), integers are pixel centres.
    """

    # the homography of any instant, from those of the frames: what a run stores is all that it renders along
    trajectory: Trajectory
    span: FrameSpan  # the frames from the first to the last that a located exposure holds
    homographies: FloatArray  # (T, 3, 3), one for each frame
    located: BoolArray  # (T,), False outside `span`, and for frames without light
    std_px: FloatArray  # (T,) expected corner error, infinite where not located
    reference: int  # the frame whose homography is the identity
    frame_shape: tuple[int, int]  # (height, width) of a frame
    camera: Camera | None = None  # that turns; None where homographies are any. Theirs are K R K^-1 of determinant 1 otherwise.
    remaining_px: FloatArray | float = 0.0  # (T,) the part of `std_px` that a correction of the motion may find

    @property
    def noise_px(self) -> FloatArray:
        """The rest of `std_px`: (T,)."""
        return np.asarray(np.sqrt(np.maximum(self.std_px**2 - np.square(self.remaining_px), 0)))

    @property
    def rotations(self) -> FloatArray | None:
        """Rotations from the camera at each frame to that at the reference frame, (T, 3, 3); None without a camera."""
        return None if self.camera is None else nearest_rotations(self.camera.rotations(self.homographies))


def view_of(motion: FrameMotion, source: Source, projection: str = "auto", *, level: bool = False) -> View:
    """Return how the panorama of a capture along a motion is projected."""
    turns = motion.camera is not None
    return View(projection, level, motion.camera if turns else camera_of(source), turns)


def motion_of_frames(levels: Sequence[LevelResult], stream: StreamInfo, reference: int) -> FrameMotion:
    """Evaluate the result of the last level, of at least one, at every frame.

    That at `reference` is the identity, or at the next frame that is located.
    """
    last = levels[-1]
    frames, span = np.arange(stream.n_frames), last.located.covered
    located = (span.start <= frames) & (frames < span.stop)
    if (timeline := last.exposures.timeline) is not None:
        located &= timeline.shown
    std_px, remaining_px = np.where(located, last.uncertainty.at(frames), np.inf), last.uncertainty.remaining_at(frames)
    homographies = np.concatenate([last.trajectory.at(block) for block in np.split(frames, frames[BLOCK_FRAMES::BLOCK_FRAMES])])
    camera = camera_of_motion(last.trajectory)
    if not located[reference]:
        reference = int(frames[located][np.abs(frames[located] - reference).argmin()])
        homographies = np.linalg.inv(homographies[reference]) @ homographies
        if camera is None:
            homographies = normalised(homographies)
    trajectory = FrameTrajectory(homographies)
    return FrameMotion(
        trajectory=trajectory,
        span=span,
        homographies=homographies,
        located=located,
        std_px=std_px,
        reference=reference,
        frame_shape=stream.frame_shape,
        camera=camera,
        remaining_px=remaining_px,
    )


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
    if np.count_nonzero(near) < 2:
        return here
    times = instants[near] - instant
    if motion.camera is not None:
        vectors = rotation_vectors(nearest_rotations(motion.camera.rotations(relative[near])))
        return np.asarray(here @ motion.camera.homographies(rotation_matrices(_at_zero(times, vectors, std))))
    smooth = _at_zero(times, points[near, :, :2] / points[near, :, 2:], std)
    to_frame = cv2.getPerspectiveTransform(frame.astype(np.float32), smooth.astype(np.float32))
    return np.asarray(here @ normalised(to_frame))


def _instants(instant: float, span: FrameSpan, std: float) -> FloatArray:
    first, last = max(instant - _REACH * std, span.start), min(instant + _REACH * std, span.stop - 1)
    number = min(int(last - first) + 1, _MOST_INSTANTS)
    return np.unique(np.linspace(first, last, max(number, 1)).round())


def _at_zero(times: FloatArray, values: FloatArray, std: float) -> FloatArray:
    """Return the value at time 0 of the line of least squares through (N, ...) values, with Gaussian weights."""
    line = np.polyfit(times, values.reshape(len(times), -1), 1, w=np.exp(-0.25 * (times / std) ** 2))
    return np.asarray(line[1].reshape(values.shape[1:]))
