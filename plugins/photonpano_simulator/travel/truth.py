"""The truth of a capture with depth: where each frame was taken from, and what it shows, from the truth file alone.

Convention:
    Points of the world are (x, y, z) in m: x right, y down, z ahead. `camera_from_world` (3, 4) maps them to points of the
    camera, X_c = R X_w + t, with the same axes; pixels are K X_c, integers are pixel centres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, InputError
from photonpano.geometry import Camera
from photonpano.reading import read_arrays
from photonpano_simulator.travel.planes import LensView, Planes, Scene, View, atlas_of, trace, view_of
from photonpano_simulator.views import pixel_grid

# Names of arrays in a truth file: the fields of `Planes`, and the others.
_PLANES = {
    "plane_corners": "corner",
    "plane_along": "along",
    "plane_down": "down",
    "plane_velocities": "velocity",
    "plane_is_disc": "is_disc",
}
_ARRAYS = ["camera_from_world", "camera_matrix", "frame_shape", "taken", "light", "textures", "texture_shapes", "texture_flux"]
_UNFOLDED_PX = 1e-3
_SAME = 1e-6  # relative difference below which two inverse depths are of the same point


@dataclass(frozen=True, eq=False)
class TravelTruth:
    """The truth of a capture of a scene with depth."""

    camera_from_world: FloatArray  # (T, 3, 4), the pose of each frame of the capture
    camera: Camera
    frame_shape: tuple[int, int]
    taken: NDArray[np.int64]  # (T,), when each frame was taken: its index before any were dropped or repeated
    light: FloatArray  # (T,), light of each frame, relative to the first that was taken
    scene: Scene
    flux: float  # photons per pixel per frame that are detected where a texture is 1

    @cached_property
    def view(self) -> View | LensView:
        """The renderer of frames."""
        return view_of(self.scene.planes, atlas_of(self.scene.textures, self.flux), self.camera, self.frame_shape)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """Return the truth as arrays by name; `truth_of` is the inverse."""
        planes, textures = self.scene.planes, self.scene.textures
        return {
            "camera_from_world": self.camera_from_world,
            "camera_matrix": self.camera.matrix,
            **({"distortion": self.camera.distortion} if self.camera.distorts else {}),
            "frame_shape": np.array(self.frame_shape),
            "taken": self.taken,
            "light": self.light,
            **{name: getattr(planes, field) for name, field in _PLANES.items()},
            "textures": np.concatenate([each.ravel() for each in textures]),
            "texture_shapes": np.array([each.shape for each in textures]),
            "texture_flux": np.array(self.flux),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """Where the pixels of a frame are in another frame."""

    # (H, W, 2), from the place of a pixel's point in the first frame to its place in the other, (x, y) in px; NaN where the
    # pixel shows nothing, or where its point lies behind the other camera
    vectors: FloatArray
    # (H, W), whether the other frame shows the point: within the frame, and not behind another plane
    visible: NDArray[np.bool_]


def read_truth(path: Path | str) -> TravelTruth:
    """Read the truth file of a capture of `travel-simulator`; raises an `InputError` if it is missing, or something else."""
    path = Path(path)
    return truth_of(read_arrays(path, "a truth of travel-simulator"), str(path))


def truth_of(arrays: Mapping[str, NDArray[Any]], name: str = "the truth") -> TravelTruth:
    """Return the truth from its arrays; raises an `InputError` if one is missing."""
    missing = [each for each in (*_ARRAYS, *_PLANES) if each not in arrays]
    if missing:
        why = "is the truth of a scene without depth" if "homographies" in arrays else "is no truth of travel-simulator"
        raise InputError(f"{name} {why}: it lacks {missing[0]}")
    shapes = arrays["texture_shapes"].astype(int)
    pieces = np.split(arrays["textures"], np.cumsum(shapes.prod(axis=1))[:-1])
    textures = tuple(piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True))
    height, width = arrays["frame_shape"].tolist()
    return TravelTruth(
        arrays["camera_from_world"],
        Camera(arrays["camera_matrix"], arrays.get("distortion", np.zeros(4))),
        (height, width),
        arrays["taken"],
        arrays["light"],
        Scene(Planes(**{field: arrays[name] for name, field in _PLANES.items()}), textures),
        float(arrays["texture_flux"]),
    )


def depth(truth: TravelTruth, frame: int) -> FloatArray:
    """Return the depth of what a frame shows at its pixel centres: (H, W), along the optical axis in m; inf for nothing."""
    ideal = truth.camera.ideal(pixel_grid(truth.frame_shape).reshape(-1, 2))
    _, inverse_depth = _traced(truth, _require(truth, frame), ideal)
    with np.errstate(divide="ignore"):
        return np.asarray((1 / inverse_depth).reshape(truth.frame_shape))


def flow(truth: TravelTruth, from_frame: int, to_frame: int) -> Flow:
    """Return where the points that a frame shows at its pixel centres are in another frame."""
    start, end = _require(truth, from_frame), _require(truth, to_frame)
    pixels = pixel_grid(truth.frame_shape).reshape(-1, 2)
    ideal, matrix, planes = truth.camera.ideal(pixels), truth.camera.matrix, truth.scene.planes
    owner, inverse_depth = _traced(truth, start, ideal)
    shown = owner >= 0
    rays = np.concatenate([ideal[shown], np.ones((int(shown.sum()), 1))], axis=1) @ np.linalg.inv(matrix).T
    first, second = truth.camera_from_world[start], truth.camera_from_world[end]
    world = (rays / inverse_depth[shown, None] - first[:, 3]) @ first[:, :3]
    world += (truth.taken[end] - truth.taken[start]) * planes.velocity[owner[shown]]
    seen = (world @ second[:, :3].T + second[:, 3]) @ matrix.T
    ahead = seen[:, 2] > 0
    there = np.full((len(pixels), 2), np.nan)
    passed = np.where(ahead[:, None], seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None], np.nan)
    there[shown] = truth.camera.distorted(passed)
    height, width = truth.frame_shape
    visible = np.asarray((there >= -0.5).all(axis=1) & (there <= (width - 0.5, height - 0.5)).all(axis=1), np.bool_)
    own = np.zeros(len(pixels))
    own[shown] = 1 / np.where(ahead, seen[:, 2], np.inf)
    ideal = truth.camera.ideal(there[visible])
    _, nearest = _traced(truth, end, ideal)
    # Beyond the radius at which a lens folds the image over, it would image points that it does not.
    unfolded = (np.abs(ideal - passed[visible[shown]]) < _UNFOLDED_PX).all(axis=1)
    visible[visible] = unfolded & (nearest <= own[visible] * (1 + _SAME))
    return Flow((there - pixels).reshape(height, width, 2), visible.reshape(height, width))


def sharp_view(truth: TravelTruth, frame: int) -> NDArray[np.float32]:
    """Return the flux of a frame, (H, W), without noise and dark counts: photons that are detected per pixel per frame."""
    place = _require(truth, frame)
    return truth.view.flux(truth.camera_from_world[place], float(truth.taken[place])) * np.float32(truth.light[place])


def _require(truth: TravelTruth, frame: int) -> int:
    last = len(truth.camera_from_world) - 1
    if not 0 <= frame <= last:
        raise InputError(f"there is no frame {frame}; the capture has the frames 0 to {last}")
    return frame


def _traced(truth: TravelTruth, frame: int, points: FloatArray) -> tuple[NDArray[np.int32], FloatArray]:
    """Return the plane that is seen at some ideal pixels (N, 2) of a frame, (N,), -1 for none, and its inverse depth, (N,)."""
    planes = truth.scene.planes
    maps = planes.maps(truth.camera_from_world[frame], truth.camera.matrix, float(truth.taken[frame]))
    owner, inverse_depth = np.empty(len(points), np.int32), np.empty(len(points))
    trace(points, maps, planes.radii, owner, inverse_depth)
    return owner, inverse_depth
