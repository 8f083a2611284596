"""Source `travel-simulator`: frames of a scene with depth, seen along a path, and the truth about them.

The truth holds where each frame was taken from, and what it shows, in its file alone. Frames are rendered when they are read.

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

from photonpano import FloatArray, InputError, SourceContext
from photonpano.geometry import Camera, camera_matrix, positions_of, rotation_matrices
from photonpano.reading import read_arrays
from photonpano_simulator.camera import Draw, generator, pixel_grid
from photonpano_simulator.paths import looking, random_path, random_spline, shake_rotations, sums_of_sines
from photonpano_simulator.source import SimulatedSource
from photonpano_simulator.travel_config import TravelConfig, TravelPath
from photonpano_simulator.travel_planes import LensView, Planes, Scene, View, atlas_of, trace, view_of
from photonpano_simulator.travel_stage import Stage, with_objects

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
_DEPTHS = 16  # frames whose depth is in the truth, at most
_METERED = 9  # frames along the path over which the mean flux is taken


@dataclass(frozen=True, eq=False, kw_only=True)
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
        camera_from_world=arrays["camera_from_world"],
        camera=Camera(arrays["camera_matrix"], arrays.get("distortion", np.zeros(4))),
        frame_shape=(height, width),
        taken=arrays["taken"],
        light=arrays["light"],
        scene=Scene(Planes(**{field: arrays[name] for name, field in _PLANES.items()}), textures),
        flux=float(arrays["texture_flux"]),
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


class TravelSource(SimulatedSource):
    """A single-photon camera that travels through a scene with depth."""

    def __init__(self, config: TravelConfig, context: SourceContext) -> None:
        super().__init__(config, context)
        (stage, poses), camera = placed(config, self._seed), _camera_of(config)
        scene = stage.drawn(context.threads)
        metered = view_of(scene.planes, atlas_of(scene.textures), camera, config.frame_shape)
        frames = np.linspace(0, len(poses) - 1, _METERED).astype(int)
        mean = float(np.mean([metered.flux(poses[frame], frame) for frame in frames]))
        self._truth = TravelTruth(
            camera_from_world=poses[self._taken],
            camera=camera,
            frame_shape=config.frame_shape,
            taken=self._taken,
            light=self._light[self._taken],
            scene=with_objects(
                scene, config.objects, poses[0], matrix=camera.matrix, frame_shape=config.frame_shape, mean=mean
            ),
            flux=config.flux * config.sensor.quantum_efficiency / mean,
        )
        self._order = np.argsort(self._taken, kind="stable")
        # Rendered from the first thread on, it is made once.
        _ = self._truth.view

    def _incident(self, taken: int) -> NDArray[np.float32]:
        # Of a frame that is missing in the capture, the next one.
        place = min(int(np.searchsorted(self._taken, taken, sorter=self._order)), len(self._order) - 1)
        return sharp_view(self._truth, int(self._order[place])) * self._sensor.gains

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the frames: `docs/how-to/simulate-depth.md` lists the arrays.

        Convention:
            Points of the world are (x, y, z) in m: x right, y down, z ahead. `camera_from_world` maps them to points of the
            camera, X_c = R X_w + t, with the same axes; pixels are K X_c, integers are pixel centres.
        """
        gains = {"gains": self._sensor.gains} if (self._sensor.gains != 1).any() else {}
        frames = np.unique(np.linspace(0, self.info.n_frames - 1, _DEPTHS).round().astype(int))
        depths = np.stack([depth(self._truth, frame) for frame in frames.tolist()]).astype(np.float32)
        return {**super().truth(), **self._truth.arrays(), **gains, "depth_frames": frames, "depths": depths}

    def sharp_view(self, frame: int) -> NDArray[np.float32]:
        """Return the flux of a frame without noise, dark counts and differences between pixels: (H, W)."""
        return sharp_view(self._truth, frame)


def placed(config: TravelConfig, seed: int) -> tuple[Stage, FloatArray]:
    """Place the scene and the poses of all frames, (T, 3, 4); raises an `InputError` if they do not suit each other."""
    stage = Stage(config)
    poses = _poses_of(config, stage.middle, seed)
    _require_free(poses, _camera_of(config), config.frame_shape, stage.planes, stage.free)
    return stage, poses


_CHECKED = 2000  # frames at which a path is checked, at most
_LOOKED = 60  # largest number of frames that are checked for rays that miss the scene
_GRID = 9  # points along each side of such a frame
_REACH = (1.0, 0.45, 0.6)  # how far a random path reaches along x, y and z, relative to each other


def _camera_of(config: TravelConfig) -> Camera:
    """Return the camera."""
    if config.centre_px is None:
        return Camera.of(config.focal_px, config.frame_shape, config.distortion.coefficients)
    return Camera(camera_matrix(config.focal_px, config.centre_px), np.array(config.distortion.coefficients))


def _poses_of(config: TravelConfig, middle: FloatArray, seed: int) -> FloatArray:
    """Return the poses of all frames, (T, 3, 4); the camera looks at the `middle`, (3,) in m, by default.

    Raises an `InputError` if it is to look at the point where it is, or straight up or down.
    """
    path, n_frames = config.path, config.n_frames
    target = middle if path.look_at is None else np.array(path.look_at)
    progress = np.linspace(0, 1, n_frames)
    if isinstance(path, TravelPath):
        rng, gaze = generator(path.seed, Draw.PATH), random_spline((1, 1, 1), path.knots, generator(path.seed, Draw.GAZE))
        positions = np.array(path.centre) + random_path(_REACH, path.length_m, path.knots, progress, rng)
        rotations = rotation_matrices(np.deg2rad(path.wander_deg) * gaze(progress)) @ _looking(positions, target)
    else:
        positions = np.broadcast_to(np.array(path.centre), (n_frames, 3))
        yaw = np.deg2rad(path.degrees) * (progress - 0.5)
        rotations = _looking(positions[:1], target) @ rotation_matrices(np.outer(-yaw, (0, 1, 0)))
    if path.tremor is not None:
        tremor, rng = path.tremor, generator(seed, Draw.SHAKE)
        rotations = shake_rotations(tremor, n_frames, config.frame_rate_hz, config.focal_px, rng) @ rotations
        sines = sums_of_sines(tremor.frequencies_hz, n_frames, config.frame_rate_hz, rng).T
        positions = positions + tremor.rms_mm / 1000 * sines
    return np.concatenate([rotations, -rotations @ positions[:, :, None]], axis=2)


def _require_free(poses: FloatArray, camera: Camera, frame_shape: tuple[int, int], planes: Planes, room: FloatArray) -> None:
    """Require that the camera stays in the scene, passes through no surface that rests, and sees nothing but the scene.

    `room` (2, 3) are the smallest and the largest coordinates that the camera may have, in m.
    """
    last = len(poses) - 1
    frames = np.unique(np.linspace(0, last, min(len(poses), _CHECKED)).astype(int))
    at = positions_of(poses[frames])
    outside = np.flatnonzero(((at < room[0]) | (at > room[1])).any(axis=1))
    if outside.size:
        low, high = (", ".join(f"{each:g}" for each in corner) for corner in room)
        raise InputError(
            f"the camera leaves the scene: it is at {_point(at[outside[0]])}, {outside[0] / max(1, len(at) - 1):.0%} of the "
            f"way along, and may be between ({low}) and ({high}) m; move path.centre, or shorten the path"
        )
    crossed = _first_crossing(at, planes)
    if crossed is not None:
        place, point = crossed
        raise InputError(
            f"the path of the camera passes through a surface of the scene at {_point(point)}, "
            f"{place / max(1, len(at) - 1):.0%} of the way along; move path.centre, or shorten path.length_m"
        )
    height, width = frame_shape
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID)), axis=-1).reshape(-1, 2)
    ideal, owner, inverse_depth = camera.ideal(grid), np.empty(len(grid), np.int32), np.empty(len(grid))
    for frame in np.unique(np.linspace(0, last, min(len(poses), _LOOKED)).astype(int)):
        trace(ideal, planes.maps(poses[frame], camera.matrix, 0.0), planes.radii, owner, inverse_depth)
        if (owner < 0).any():
            x, y = grid[owner < 0][0]
            raise InputError(
                f"the camera sees past the end of the scene {frame / max(1, last):.0%} of the way along: there is nothing at "
                f"the pixel ({x:.0f}, {y:.0f}); move path.look_at to the middle of the scene, or turn by less"
            )


def _point(point: FloatArray) -> str:
    return f"({', '.join(f'{each:.2f}' for each in point)}) m"


def _first_crossing(at: FloatArray, planes: Planes) -> tuple[int, FloatArray] | None:
    """Return the first step of a way (N, 3) that passes through a plane, and where; None if no step does."""
    found: tuple[int, FloatArray] | None = None
    start, way = at[:-1], np.diff(at, axis=0)
    for corner, along, down in zip(planes.corner, planes.along, planes.down, strict=True):
        to_plane = np.linalg.inv(np.stack([along, down, np.cross(along, down)], axis=1))
        begin, step = (start - corner) @ to_plane.T, way @ to_plane.T
        crosses = (begin[:, 2] > 0) != (begin[:, 2] + step[:, 2] > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(crosses, -begin[:, 2] / step[:, 2], 0.0)
        places = begin[:, :2] + share[:, None] * step[:, :2]
        hits = np.flatnonzero(crosses & (places >= 0).all(axis=1) & (places <= 1).all(axis=1))
        if hits.size and (found is None or hits[0] < found[0]):
            found = int(hits[0]), start[hits[0]] + share[hits[0]] * way[hits[0]]
    return found


def _looking(positions: FloatArray, target: FloatArray) -> FloatArray:
    """Return rotations of the world to cameras that look at a point, level: (T, 3, 3)."""
    ahead = target - positions
    if (np.hypot(ahead[:, 0], ahead[:, 2]) <= 1e-6 * np.maximum(np.linalg.norm(ahead, axis=1), 1.0)).any():
        raise InputError(
            f"the camera cannot look at {_point(target)}: on its path that is where it is, or straight above or below it; "
            "move path.look_at"
        )
    return looking(ahead)
