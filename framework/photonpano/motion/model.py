"""The model of the motion: any homographies, or rotations of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photonpano.geometry import Camera, camera_matrix
from photonpano.motion.planar import PlanarName

ModelName = Literal["auto", "translation", "euclidean", "similarity", "affine", "homography", "rotation"]
# Initial focal length, in longer sides of a frame.
_FIRST_FOCAL = 3.0
_LENS = (None, None, 0.0, 0.0)  # what "auto" finds of a lens: k1 and k2
SAME_LENS_PX = 0.05  # largest difference of what two lenses do to a frame that does not matter
_FAR_FOCAL = 1e4  # that of a camera whose turns shift and roll the image


@dataclass(frozen=True, slots=True)
class MotionModel:
    """The model of the motion of a camera."""

    kind: ModelName = "homography"  # "auto" for the one that the pairs support
    focal_px: float | None = None  # of the camera; None if it is to be found
    centre_px: tuple[float, float] | None = None  # (x, y) of its principal point; None for the middle of the frames
    # k1, k2, p1, p2 of its lens; None for those that are to be found
    distortion: tuple[float | None, float | None, float | None, float | None] = (0.0, 0.0, 0.0, 0.0)
    known: Camera | None = None  # the camera that the level before has found
    layered: bool = False  # whether frames are known to show more than a background that follows the camera

    @property
    def unknown(self) -> tuple[int, ...]:
        """Which numbers of the camera are to be found: 0 for the focal length, 1 to 4 for k1, k2, p1, p2."""
        return tuple(index for index, number in enumerate((self.focal_px, *self.distortion)) if number is None)

    @property
    def name(self) -> str:
        """Its name, such as "rotation with a lens" where the distortion is to be found."""
        return f"{self.kind} with a lens" if self.finds_lens else self.kind

    @property
    def planar(self) -> PlanarName:
        """The group of its homographies; any but those of a rotation have one."""
        if self.kind == "rotation" or self.kind == "auto":
            raise ValueError(f"{self.kind} is no planar model")
        return self.kind

    @property
    def rotations(self) -> tuple[MotionModel, ...]:
        """The rotations that "auto" compares with homographies: without a lens, and with one unless that is known."""
        rotation = replace(self, kind="rotation")
        if any(self.distortion) or self.finds_lens:
            return (rotation,)
        return rotation, replace(rotation, distortion=_LENS)

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
        if self.known is None and self.focal_px is None:
            if self.kind != "auto":
                return None
            middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
            return Camera(camera_matrix(_FAR_FOCAL * max(frame_shape), middle))
        return self.camera(frame_shape) if self.kind in ("rotation", "auto") else None

    def knowing(self, camera: Camera | None) -> MotionModel:
        """Return the model after a level that has found the camera, or None.

        Frames are then seen through its lens, if it has one: "auto" keeps to that, and goes on to find it.
        """
        if camera is None:
            return self
        if self.kind == "auto" and camera.distorts:
            return replace(self, kind="rotation", distortion=self.distortion if self.finds_lens else _LENS, known=camera)
        return replace(self, known=camera)


HOMOGRAPHIES = MotionModel()
