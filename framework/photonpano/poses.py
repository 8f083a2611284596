"""The poses of a camera that turns, as files of other programs.

Convention:
    Rotations map directions of a frame's camera to those of the reference camera, x right, y down, z ahead. The camera stays
    where it is: all translations are zero. Integers are pixel centres here; COLMAP and nerfstudio add 0.5.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import Camera
from photonpano.values import FloatArray

PoseFormat: TypeAlias = Literal["colmap", "nerfstudio", "tum"]

_GRAPHICS = np.diag([1.0, -1.0, -1.0])
"""Axes of a camera in OpenGL, x right, y up, z back, to ours."""
_UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Directions of the reference camera to a world whose z is up, in which that camera looks along y."""


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Where a camera looked.

    Attributes:
        camera: of all frames.
        frame_shape: (height, width) of a frame.
        frames: (N,) their indices in the capture.
        rotations: (N, 3, 3), directions of each frame's camera to those of the reference camera.
        seconds: (N,) times of the frames.
        digits: of the numbers in names of frames.
    """

    camera: Camera
    frame_shape: tuple[int, int]
    frames: NDArray[np.int64]
    rotations: FloatArray
    seconds: FloatArray
    digits: int

    @property
    def names(self) -> list[str]:
        """File names of the frames, such as `frame_0042.png`."""
        return [f"frame_{frame:0{self.digits}}.png" for frame in self.frames]


def colmap(poses: Poses) -> dict[str, str]:
    """Return the text files of a COLMAP model by name: one OPENCV camera, an image for each frame, and no points."""
    camera, (height, width) = poses.camera, poses.frame_shape
    centre = (each + 0.5 for each in camera.centre_px)
    numbers = (camera.matrix[0, 0], camera.matrix[1, 1], *centre, *camera.distortion)
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then its points"]
    to_camera = _quaternions(np.swapaxes(poses.rotations, -1, -2))
    for place, (name, (x, y, z, w)) in enumerate(zip(poses.names, to_camera, strict=True), start=1):
        images += [f"{place} {_line(w, x, y, z)} 0 0 0 1 {name}", ""]
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY, K1, K2, P1, P2"]
    cameras.append(f"1 OPENCV {width} {height} {_line(*numbers)}")
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK"]
    files = {"cameras.txt": cameras, "images.txt": images, "points3D.txt": points}
    return {name: "\n".join(lines) + "\n" for name, lines in files.items()}


def nerfstudio(poses: Poses) -> dict[str, str]:
    """Return the `transforms.json` of nerfstudio: cameras have the axes of OpenGL, and z of the world is up."""
    camera, (height, width) = poses.camera, poses.frame_shape
    poses_4x4 = np.tile(np.eye(4), (len(poses.frames), 1, 1))
    poses_4x4[:, :3, :3] = _UPRIGHT @ poses.rotations @ _GRAPHICS
    content = {
        "camera_model": "OPENCV",
        "fl_x": camera.matrix[0, 0],
        "fl_y": camera.matrix[1, 1],
        "cx": camera.centre_px[0] + 0.5,
        "cy": camera.centre_px[1] + 0.5,
        "w": width,
        "h": height,
        **dict(zip(("k1", "k2", "p1", "p2"), camera.distortion.tolist(), strict=True)),
        "frames": [
            {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
            for name, pose in zip(poses.names, poses_4x4, strict=True)
        ],
    }
    return {"transforms.json": json.dumps(content, indent=1) + "\n"}


def tum(poses: Poses) -> dict[str, str]:
    """Return the trajectory as the TUM benchmark has it: seconds, position, quaternion of the camera in the world."""
    rows = zip(poses.seconds, _quaternions(poses.rotations), strict=True)
    lines = ["# seconds tx ty tz qx qy qz qw", *(f"{_line(second)} 0 0 0 {_line(*q)}" for second, q in rows)]
    return {"trajectory.txt": "\n".join(lines) + "\n"}


POSE_FORMATS: Mapping[PoseFormat, Callable[[Poses], dict[str, str]]] = {"colmap": colmap, "nerfstudio": nerfstudio, "tum": tum}
"""Each returns the content of files by name."""


def _quaternions(rotations: FloatArray) -> FloatArray:
    """Return x, y, z, w of rotations, (N, 4), with w not below 0."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_quat(canonical=True))


def _line(*numbers: float) -> str:
    return " ".join(repr(float(number)) for number in numbers)
