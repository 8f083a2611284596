"""The model of the motion: any homographies, or rotations of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photonpano.geometry import Camera, camera_matrix

ModelName = Literal["homography", "rotation", "auto"]
# Initial focal length, in longer sides of a frame.
_FIRST_FOCAL = 3.0


@dataclass(frozen=True, slots=True)
class MotionModel:
    """The model of the motion of a camera."""

    kind: ModelName = "homography"  # any homographies, rotations of one camera, or "auto": the model that the pairs support
    focal_px: float | None = None  # of the camera; None if it is to be found
    centre_px: tuple[float, float] | None = None  # (x, y) of its principal point; None for the middle of the frames
    # k1, k2, p1, p2 of its lens; None for those that are to be found
    distortion: tuple[float | None, float | None, float | None, float | None] = (0.0, 0.0, 0.0, 0.0)
    known: Camera | None = None  # the camera that the level before has found

    @property
    def unknown(self) -> tuple[int, ...]:
        """Which numbers of the camera are to be found: 0 for the focal length, 1 to 4 for k1, k2, p1, p2."""
        return tuple(index for index, number in enumerate((self.focal_px, *self.distortion)) if number is None)

    @property
    def finds_lens(self) -> bool:
        """Whether the distortion of the lens is to be found."""
        return any(index > 0 for index in self.unknown)

    def camera(self, frame_shape: tuple[int, int]) -> Camera:
        """Return what is known of the camera so far; what is not begins at 3 sides of a frame, and without distortion."""
        if self.known is not None:
            return self.known
        middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
        matrix = camera_matrix(self.focal_px or _FIRST_FOCAL * max(frame_shape), self.centre_px or middle)
        return Camera(matrix, np.array([number or 0.0 for number in self.distortion]))

    def seen_by(self, frame_shape: tuple[int, int]) -> Camera:
        """Return the camera by whose lens frames are warped: without distortion as long as its focal length is unknown."""
        camera = self.camera(frame_shape)
        if self.known is None and self.focal_px is None:
            return Camera(camera.matrix)
        return camera

    def turning_camera(self, frame_shape: tuple[int, int]) -> Camera | None:
        """Return the camera that locators may use: one that only turns, of a focal length that is given or was found."""
        if self.kind != "rotation" or (self.known is None and self.focal_px is None):
            return None
        return self.camera(frame_shape)

    def knowing(self, camera: Camera | None) -> MotionModel:
        """Return the model after a level that has found the camera, or None."""
        return self if camera is None else replace(self, known=camera)


HOMOGRAPHIES = MotionModel()
