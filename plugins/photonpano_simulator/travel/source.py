"""Source `travel-simulator`: frames of a scene with depth, seen along a path, rendered when they are read.

Convention:
    Points of the world are (x, y, z) in m: x right, y down, z ahead. A pose (3, 4) maps them to points of the camera,
    X_c = R X_w + t, with the same axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, InputError, SourceContext
from photonpano.geometry import Camera, camera_matrix, positions_of, rotation_matrices
from photonpano_simulator.paths import looking, random_path, random_spline, shake_rotations, sums_of_sines
from photonpano_simulator.sensor import Draw, generator
from photonpano_simulator.source import SimulatedSource
from photonpano_simulator.travel.planes import Planes, atlas_of, trace, view_of
from photonpano_simulator.travel.stage import Stage, with_objects
from photonpano_simulator.travel.truth import TravelTruth, sharp_view
from photonpano_simulator.travel_config import TravelConfig, TravelPath

_METERED = 9  # frames along the path over which the mean flux is taken


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
            poses[self._taken],
            camera,
            config.frame_shape,
            self._taken,
            self._light[self._taken],
            with_objects(scene, config.objects, poses[0], camera.matrix, config.frame_shape, mean),
            config.flux * config.sensor.quantum_efficiency / mean,
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
        return {**super().truth(), **self._truth.arrays(), **gains}

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
