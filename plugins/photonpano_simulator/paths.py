"""Camera paths: where each frame lies in the scene.

Convention:
    Points are (x, y), x right, y down; integers are pixel centres; sizes are (height, width). Homographies map pixels of a
    frame to pixels of the scene, h33 = 1. The camera only turns: a homography is K' R K^-1, where the scene is the image that
    the same lens makes when it looks straight at the middle of the scene. Before a panorama all around, a homography is
    K R K^-1 with determinant 1, where h33 may be 0 or negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from photonpano import FloatArray, InputError
from photonpano.geometry import Camera, camera_matrix, inverse, normalised, rescaling, rotation_matrices, transform_points
from photonpano.reading import read_array, read_arrays
from photonpano_simulator.camera import Draw, camera, generator, middle_of, outline
from photonpano_simulator.config import (
    FilePath,
    HandShakePath,
    LoopPath,
    MovingPath,
    PanPath,
    ScanPath,
    Shake,
    SimulationConfig,
    SplinePath,
    TurnPath,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_DENSE = 100_000  # points of a curve before it is resampled at constant speed; the error is far below 0.001 px
_POINTS_OF_A_SIDE = 17  # points along each side of a frame that must lie in the panorama
_BLOCK = 8192  # frames that are checked at a time, which bounds the memory
_RAMP = 0.02  # share of the capture in which a camera slows down before it rests, and gets going afterwards
_SPLINE_REACH = (1.0, 0.5)  # how far a random path reaches along x and y, relative to each other


def camera_path(config: SimulationConfig, scene_shape: tuple[int, int], seed: int) -> FloatArray:
    """Return the true homographies of all frames, (T, 3, 3), frame pixels to scene pixels.

    Raises an `InputError` if a frame reaches beyond the scene, or the file of the path cannot be used.
    """
    path, focal = config.path, config.focal_length_px
    frame = _intrinsics(config.frame_shape, focal)
    if isinstance(path, TurnPath):
        return _turn(config, path, scene_shape, seed)
    if isinstance(path, FilePath):
        homographies = _along(path, _read_homographies(path.file, config.n_frames))
    else:
        to_scene = rescaling(config.scene_scale)
        in_frame_px = scene_shape[0] / config.scene_scale, scene_shape[1] / config.scene_scale
        middle = middle_of(in_frame_px)
        target = middle if path.centre is None else transform_points(inverse(to_scene), np.array([path.centre], np.float64))[0]
        rotations = _rotations(target - middle + _along(path, _centres(path, config.n_frames)), focal)
        homographies = to_scene @ _intrinsics(in_frame_px, focal) @ rotations @ np.linalg.inv(frame)
    if path.shake is not None:
        shaking = shake_rotations(path.shake, config.n_frames, config.frame_rate_hz, focal, generator(seed, Draw.SHAKE))
        homographies = homographies @ frame @ shaking @ np.linalg.inv(frame)
    homographies = normalised(homographies)
    _require_inside(homographies, outline(config), scene_shape)
    return homographies


def camera_rotations(config: SimulationConfig, homographies: FloatArray, scene_shape: tuple[int, int]) -> FloatArray | None:
    """Return the rotations of a path, (T, 3, 3): directions of a frame to those of a camera before the middle of the scene.

    It is None for homographies from a file, which need not be rotations.
    """
    if isinstance(config.path, FilePath):
        return None
    ours = camera(config)
    if isinstance(config.path, TurnPath):
        return ours.rotations(homographies)
    in_frame_px = scene_shape[0] / config.scene_scale, scene_shape[1] / config.scene_scale
    scene = rescaling(config.scene_scale) @ _intrinsics(in_frame_px, config.focal_length_px)
    return ours.rotations(ours.matrix @ np.linalg.inv(scene) @ homographies)


def progress_of(path: MovingPath | HandShakePath, n_frames: int) -> FloatArray:
    """Return how far along its path the camera is in each frame: (n_frames,), from 0 to 1.

    Raises an `InputError` if the camera never moves, or jumps off the path.
    """
    time = np.linspace(0, 1, n_frames)
    if isinstance(path, HandShakePath) or not (path.rests or path.jumps):
        return time
    progress = np.concatenate([[0.0], np.cumsum(pace(path.rests, n_frames)[1:])])
    if not progress[-1]:
        raise InputError("path.rests leave the camera no time to move; shorten them")
    progress *= (1 - sum(jump.by for jump in path.jumps)) / progress[-1]
    for jump in path.jumps:
        progress += jump.by * (time >= jump.at)
    outside = np.abs(progress - 0.5) - 0.5
    if outside.max() > 1e-9 or progress[-1] < 0:
        worst = int(outside.argmax())
        raise InputError(
            f"path.jumps lead off the path: {time[worst]:.0%} of the capture along, the camera is at {progress[worst]:.0%} "
            "of it; jump less far, or later"
        )
    return np.asarray(np.clip(progress, 0, 1))


def pace(rests: Sequence[tuple[float, float]], n_frames: int) -> FloatArray:
    """Return the speed of something that rests in parts of the capture, relative to its speed else: (n_frames,), 0 to 1."""
    time, speed = np.linspace(0, 1, n_frames), np.ones(n_frames)
    for start, stop in rests:
        away = np.clip(np.maximum(start - time, time - stop) / _RAMP, 0, 1)
        speed *= away * away * (3 - 2 * away)
    return speed


def camera_positions(path: MovingPath | HandShakePath, n_frames: int) -> FloatArray:
    """Return where the camera is in each frame, before the middle of the scene and relative to its start: (n_frames, 3) m."""
    if isinstance(path, HandShakePath):
        return np.zeros((n_frames, 3))
    progress = progress_of(path, n_frames)
    return np.outer(progress * progress * (3 - 2 * progress), path.travel_m)


def _along(path: MovingPath | HandShakePath, samples: FloatArray) -> FloatArray:
    """Return samples (T, ...) of a path at constant speed where the camera is in each frame."""
    n_frames = len(samples)
    progress, flat = progress_of(path, n_frames), samples.reshape(n_frames, -1)
    if np.array_equal(progress, np.linspace(0, 1, n_frames)):
        return samples
    place = progress * (n_frames - 1)
    return np.stack([np.interp(place, np.arange(n_frames), each) for each in flat.T], axis=-1).reshape(samples.shape)


def scene_motion(homographies: FloatArray, frame_shape: tuple[int, int], path: object) -> FloatArray:
    """Return how far the scene has moved through the middle of the frame since the first frame: (T, 2) px."""
    middle = middle_of(frame_shape)
    if isinstance(path, TurnPath):
        steps = transform_points(inverse(homographies[1:]) @ homographies[:-1], middle[None])[:, 0] - middle
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.asarray(transform_points(inverse(homographies), transform_points(homographies[0], middle[None]))[:, 0] - middle)


def _turn(config: SimulationConfig, path: TurnPath, scene_shape: tuple[int, int], seed: int) -> FloatArray:
    """Return K R K^-1 of a camera that turns before a panorama of (height, width), 360 degrees wide: (T, 3, 3)."""
    focal, per_radian = config.focal_length_px, scene_shape[1] / (2 * np.pi)
    if per_radian < focal * config.scene_scale / 2:
        raise InputError(
            f"a scene of {scene_shape[1]} px all around is too coarse for a focal length of {focal:g} px, which sees "
            f"{2 * np.pi * focal * config.scene_scale:,.0f} px; take a wider scene, or lower focal_length_px"
        )
    progress = progress_of(path, config.n_frames)
    phase, zero = 2 * np.pi * path.wobbles * progress, np.zeros(config.n_frames)
    pitch = -np.deg2rad(path.pitch_wobble_deg) * np.sin(phase)
    roll = np.deg2rad(path.roll_wobble_deg) * np.cos(phase)
    rotations = rotation_matrices(np.stack([zero, np.deg2rad(path.degrees) * progress, zero], axis=1))
    rotations = rotations @ rotation_matrices(np.stack([pitch, zero, zero], axis=1))
    rotations = rotations @ rotation_matrices(np.stack([zero, zero, roll], axis=1))
    if path.shake is not None:
        random = generator(seed, Draw.SHAKE)
        rotations = rotations @ shake_rotations(path.shake, config.n_frames, config.frame_rate_hz, focal, random)
    _require_seen(rotations, camera(config), outline(config), scene_shape)
    return camera(config).homographies(rotations)


def _require_seen(rotations: FloatArray, ours: Camera, frame: FloatArray, scene_shape: tuple[int, int]) -> None:
    """Require that the panorama reaches as high and as low as the frames, whose outline is (N, 2) ideal pixels."""
    low, high = frame.min(axis=0), frame.max(axis=0)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, _POINTS_OF_A_SIDE).T), axis=-1).reshape(-1, 2)
    rays = np.concatenate([grid, np.ones((len(grid), 1))], axis=1) @ np.linalg.inv(ours.matrix).T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    steepest = 0.0
    for start in range(0, len(rotations), _BLOCK):
        steepest = max(steepest, float(np.abs(rotations[start : start + _BLOCK, 1] @ rays.T).max()))
    needed, reach = np.rad2deg(np.arcsin(min(1.0, steepest))), 180 * scene_shape[0] / scene_shape[1]
    if needed > reach + 1e-9:
        raise InputError(
            f"the frames reach {needed:.1f} degrees above or below the horizon, but the scene of {scene_shape[0]}x"
            f"{scene_shape[1]} px, which is 360 degrees wide, only {reach:.1f}; take a higher scene, or a smaller wobble"
        )


def _centres(path: PanPath | ScanPath | LoopPath | SplinePath | HandShakePath, n_frames: int) -> FloatArray:
    """Return the centres of the frames relative to the middle of the path: (T, 2) px."""
    match path:
        case PanPath():
            angle = np.deg2rad(path.angle_deg)
            half = path.length_px / 2 * np.array([np.cos(angle), np.sin(angle)])
            return np.linspace(-half, half, n_frames)
        case ScanPath():
            return _at_constant_speed(_raster(path), n_frames)
        case LoopPath():
            angles = np.linspace(0, 2 * np.pi, _DENSE)
            ellipse = np.stack([path.aspect * np.cos(angles), np.sin(angles)], axis=1)
            return _at_constant_speed(ellipse * (path.length_px / _length(ellipse)), n_frames)
        case SplinePath():
            rng = generator(path.seed, Draw.PATH)
            return random_path(_SPLINE_REACH, path.length_px, path.knots, np.linspace(0, 1, n_frames), rng)
        case HandShakePath():
            return np.zeros((n_frames, 2))


def _raster(path: ScanPath) -> FloatArray:
    """Return points along a raster, dense in its half circles."""
    radius = path.row_spacing_px / 2
    row = (path.length_px - (path.rows - 1) * np.pi * radius) / path.rows
    if row <= 0:
        raise InputError(
            f"the path of {path.length_px:g} px is too short for a scan of {path.rows} rows {path.row_spacing_px:g} px apart, "
            f"whose turns alone take {(path.rows - 1) * np.pi * radius:.0f} px; raise path.length_px, or lower path.rows"
        )
    angles = np.linspace(-np.pi / 2, np.pi / 2, _DENSE // path.rows)
    heights = path.row_spacing_px * (np.arange(path.rows) - (path.rows - 1) / 2)
    sides = np.where(np.arange(path.rows) % 2 == 0, 1, -1)
    points = [np.array([[-row / 2, heights[0]]])]
    for side, height in zip(sides[:-1], heights[:-1], strict=True):
        points.append(np.stack([side * (row / 2 + radius * np.cos(angles)), height + radius * (1 + np.sin(angles))], axis=1))
    points.append(np.array([[sides[-1] * row / 2, heights[-1]]]))
    return np.concatenate(points)


def random_path(
    reach: tuple[float, ...], length: float, knots: int, progress: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return a spline of a length through random knots around 0, (T, D), at times from 0 to 1; `reach` is relative."""
    spline = random_spline(reach, knots, rng)
    dense = spline(np.linspace(0, 1, _DENSE))
    middle = (dense.min(axis=0) + dense.max(axis=0)) / 2
    return np.asarray((spline(progress) - middle) * (length / _length(dense)))


def random_spline(reach: tuple[float, ...], knots: int, rng: np.random.Generator) -> CubicSpline[np.float64]:
    """Return a spline from times, 0 to 1, to points (T, D) between -reach and reach."""
    from scipy.interpolate import CubicSpline

    points = rng.uniform(-1, 1, (knots, len(reach))) * np.array(reach)
    return CubicSpline(np.linspace(0, 1, knots), points, bc_type="natural")


def _length(points: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def _at_constant_speed(points: FloatArray, n_frames: int) -> FloatArray:
    """Resample a curve, given by dense points, at equal distances along it."""
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    wanted = np.linspace(0, travelled[-1], n_frames)
    return np.stack([np.interp(wanted, travelled, coordinate) for coordinate in points.T], axis=1)


def _intrinsics(shape: tuple[float, float], focal: float) -> FloatArray:
    x, y = middle_of(shape)
    return camera_matrix(focal, (x, y))


def looking(ahead: FloatArray) -> FloatArray:
    """Return rotations of the world to level cameras that look along directions (T, 3), not straight up or down: (T, 3, 3)."""
    x, y, z = ahead.T
    side = np.hypot(x, z)
    reach, zero = np.hypot(side, y), np.zeros_like(x)
    sin_yaw, cos_yaw, sin_pitch, cos_pitch = x / side, z / side, y / reach, side / reach
    right = np.stack([cos_yaw, zero, -sin_yaw], axis=1)
    down = np.stack([-sin_yaw * sin_pitch, cos_pitch, -cos_yaw * sin_pitch], axis=1)
    return np.stack([right, down, np.stack([sin_yaw * cos_pitch, sin_pitch, cos_yaw * cos_pitch], axis=1)], axis=1)


def _rotations(displacements: FloatArray, focal: float) -> FloatArray:
    """Return rotations, first about x and then about y, that move the centre of the image by (T, 2) px: (T, 3, 3)."""
    return np.swapaxes(looking(np.column_stack([displacements, np.full(len(displacements), focal)])), 1, 2)


def shake_rotations(shake: Shake, n_frames: int, frame_rate_hz: float, focal: float, rng: np.random.Generator) -> FloatArray:
    """Return the rotations of a shaking camera: (T, 3, 3)."""
    x, y, roll = sums_of_sines(shake.frequencies_hz, n_frames, frame_rate_hz, rng)
    rolls = rotation_matrices(np.outer(np.deg2rad(shake.roll_rms_deg) * roll, (0, 0, 1)))
    return np.asarray(_rotations(shake.rms_px * np.stack([x, y], axis=1), focal) @ rolls)


def sums_of_sines(
    frequencies_hz: tuple[float, ...], n_frames: int, frame_rate_hz: float, rng: np.random.Generator
) -> FloatArray:
    """Return three sums of sines with random phases, whose root mean square is 1: (3, T)."""
    phases = rng.uniform(0, 2 * np.pi, (3, len(frequencies_hz), 1))
    phase = 2 * np.pi * np.asarray(frequencies_hz)[:, None] * np.arange(n_frames) / frame_rate_hz
    # The sum of n sines of amplitude sqrt(2 / n) has the root mean square 1.
    return np.asarray(np.sqrt(2 / len(frequencies_hz)) * np.sin(phase + phases).sum(axis=1))


def _require_inside(homographies: FloatArray, frame: FloatArray, scene_shape: tuple[int, int]) -> None:
    """Require that the outline of the frame, (N, 2), lies in the scene."""
    x, y = np.moveaxis(transform_points(homographies, frame), -1, 0)
    height, width = scene_shape
    worst = np.stack([-x, x - (width - 1), -y, y - (height - 1)]).max(axis=2)
    # Coordinates of points behind the camera are meaningless.
    depth = (homographies[:, 2, :2] @ frame.T + homographies[:, 2, 2:]).min(axis=1)
    worst[:, depth <= 0] = np.inf
    side = int(worst.max(axis=1).argmax())
    if worst[side].max() > 1e-6:
        progress = worst[side].argmax() / max(1, len(homographies) - 1)
        raise InputError(
            f"the camera path leaves the scene of {height}x{width} px by {worst[side].max():.1f} px at the "
            f"{('left', 'right', 'top', 'bottom')[side]}, {progress:.0%} of the way along; "
            "shorten or move the path, or take a larger scene"
        )


def _read_homographies(path: Path, n_frames: int) -> FloatArray:
    """Read (n_frames, 3, 3) homographies from a .npy file, or from `homographies` in an .npz archive."""
    arrays = read_arrays(path, "a file of homographies", ("homographies", "scene_projection", "camera_from_world"))
    if "scene_projection" in arrays and str(arrays["scene_projection"]) == "spherical":
        raise InputError(f"{path} is the truth of a turn, and its homographies lie on no plane; take a path of the kind turn")
    if "camera_from_world" in arrays and "homographies" not in arrays:
        raise InputError(f"{path} is the truth of a scene with depth, which has no homographies; take that of a planar scene")
    homographies = read_array(path, "a file of homographies", "homographies")
    if homographies.ndim != 3 or homographies.shape[1:] != (3, 3) or homographies.dtype.kind not in "fiu":
        raise InputError(f"{path} holds {homographies.dtype} of shape {homographies.shape}; homographies are (n_frames, 3, 3)")
    if len(homographies) != n_frames:
        raise InputError(
            f"{path} holds {len(homographies)} homographies for {n_frames} frames; set n_frames to {len(homographies)}"
        )
    if not (np.all(np.isfinite(homographies)) and np.all(homographies[:, 2, 2])):
        raise InputError(f"{path} holds homographies that are not finite, or whose h33 is 0")
    return homographies.astype(np.float64)
