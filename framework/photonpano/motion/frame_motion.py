"""The motion of every frame of a capture, as the loop leaves it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from photonpano.geometry import BLOCK_FRAMES, Camera, FrameTrajectory, nearest_rotations
from photonpano.merging.canvas_plan import View
from photonpano.motion.loop import LevelResult
from photonpano.protocols import Source, Trajectory, camera_of, camera_of_motion
from photonpano.values import BoolArray, FloatArray, FrameSpan, StreamInfo


@dataclass(frozen=True, slots=True, eq=False)
class FrameMotion:
    """The motion of T frames.

    Convention:
        Homographies map frame pixels to reference pixels; points are (x, y), integers are pixel centres.
    """

    # the homography of any instant, from those of the frames: what a run stores is all that it renders along
    trajectory: Trajectory
    span: FrameSpan  # the frames from the first to the last that a located exposure holds
    homographies: FloatArray  # (T, 3, 3), one for each frame
    located: BoolArray  # (T,), False outside `span`
    std_px: FloatArray  # (T,) expected corner error, infinite outside `span`
    reference: int  # the frame whose homography is the identity
    frame_shape: tuple[int, int]  # (height, width) of a frame
    camera: Camera | None = None  # that turns; None where homographies are any. Theirs are K R K^-1 of determinant 1 otherwise.

    @property
    def rotations(self) -> FloatArray | None:
        """Rotations from the camera at each frame to that at the reference frame, (T, 3, 3); None without a camera."""
        return None if self.camera is None else nearest_rotations(self.camera.rotations(self.homographies))


def view_of(motion: FrameMotion, source: Source, projection: str = "auto", *, level: bool = False) -> View:
    """Return how the panorama of a capture along a motion is projected."""
    turns = motion.camera is not None
    return View(projection, level, motion.camera if turns else camera_of(source), turns)


def motion_of_frames(levels: Sequence[LevelResult], stream: StreamInfo, reference: int) -> FrameMotion:
    """Evaluate the result of the last level, of at least one, at every frame; that at `reference` is the identity."""
    last = levels[-1]
    frames, span = np.arange(stream.n_frames), last.located.covered
    located = (span.start <= frames) & (frames < span.stop)
    std_px = np.where(located, last.uncertainty.at(frames), np.inf)
    homographies = np.concatenate([last.trajectory.at(block) for block in np.split(frames, frames[BLOCK_FRAMES::BLOCK_FRAMES])])
    trajectory = FrameTrajectory(homographies)
    camera = camera_of_motion(last.trajectory)
    return FrameMotion(trajectory, span, homographies, located, std_px, reference, stream.frame_shape, camera)
