"""What the motion of a camera may be: any homographies, or rotations of one camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from photonpano.geometry import Camera, camera_matrix

ModelName = Literal["homography", "rotation", "auto"]


@dataclass(frozen=True, slots=True)
class MotionModel:
    """What the motion of a camera may be.

    Attributes:
        kind: any homographies, rotations of one camera, or what the pairs say.
        focal_px: of a camera that turns; None if it is to be found.
        centre_px: (x, y) of its principal point; None for the middle of the frames.
    """

    kind: ModelName = "homography"
    focal_px: float | None = None
    centre_px: tuple[float, float] | None = None

    def camera(self, frame_shape: tuple[int, int], focal_px: float = 1000.0) -> Camera:
        """Return the camera, with a given focal length where that is to be found."""
        middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
        return Camera(camera_matrix(self.focal_px or focal_px, self.centre_px or middle))


HOMOGRAPHIES = MotionModel()
