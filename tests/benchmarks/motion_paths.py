"""How cameras and their images move: a kind of motion by its name, and its homographies along a path of a seed.

A path leads straight on, with a spline through random knots along x, along y and as a roll; what else moves, follows splines of
its own. A trembling path is the same one with sines of 1 px. Lengths are those of frames of `WIDTH` px, and shrink with them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from photonpano.geometry import corners, normalised, rotation_matrices, transform_points, translation

WIDTH = 496
LENGTHS_PX = (500, 400, 300, 200, 100, 50)
WOBBLE_PX, ROLL_DEG = 6.0, 0.4  # standard deviations of the knots
SHAKE_PX, PERIODS = 1.0, (434, 164, 76)  # root mean square along x, and along y, and frames
LENS = {"k1": -0.1, "k2": 0.03}
RESTS, GETS_GOING = 0.1, 0.04  # of a capture: half of the rest in its middle, and the time before and after at another speed
SMALL = 0.012
Array = NDArray[np.float64]


class Motion(NamedTuple):
    """A kind of motion.

    Attributes:
        model: the narrowest `motion.model` that holds it.
        roll_deg: standard deviation of the knots of the roll.
        through_deg: by which the image rolls on the way.
        zoom: by which the scene comes nearer, goes away, and is back.
        breathing: standard deviation of the knots of the scale, relative to 1.
        shear: that of the aspect, and of the skew.
        keystone: that of the change of the scale from the middle of a frame to its side, along both axes.
        travels: the length of the way, relative to that of the others, and of its wobble.
        shake_px: of a tremor along x and y, also on smooth paths.
        rests: whether the camera rests in the middle of the capture.
        focal_px: of a camera that turns in one place, or flies past a wall.
        slant_deg: of the wall: between the optical axis and its normal.
        lens: distortion.
    """

    model: str
    roll_deg: float = ROLL_DEG
    through_deg: float = 0.0
    zoom: float = 1.0
    breathing: float = 0.0
    shear: float = 0.0
    keystone: float = 0.0
    travels: float = 1.0
    shake_px: float = 0.0
    rests: bool = False
    focal_px: float = 0.0
    slant_deg: float = 0.0
    lens: dict[str, float] = {}


MOTIONS = {
    "shift": Motion("translation", roll_deg=0),
    "shift-roll": Motion("euclidean"),
    "roll-60": Motion("euclidean", through_deg=60),
    "zoom": Motion("similarity", zoom=1.6),
    "breathing": Motion("similarity", breathing=SMALL),
    "shear": Motion("affine", shear=SMALL),
    "keystone": Motion("homography", breathing=SMALL, keystone=SMALL),
    "all": Motion("homography", through_deg=60, zoom=1.6, breathing=SMALL, shear=SMALL, keystone=SMALL),
    "wall": Motion("homography", focal_px=450, slant_deg=35),
    "f430": Motion("rotation", focal_px=430),
    "f430-lens": Motion("rotation", focal_px=430, lens=LENS),
    "f600": Motion("rotation", focal_px=600),
    "f600-lens": Motion("rotation", focal_px=600, lens=LENS),
    "f2000": Motion("rotation", focal_px=2000),
    "f2000-lens": Motion("rotation", focal_px=2000, lens=LENS),
    "keystone-tremor": Motion("homography", breathing=SMALL, keystone=SMALL, shake_px=SHAKE_PX),
    "tripod": Motion("translation", roll_deg=0, travels=0, shake_px=0.02),
    "rest": Motion("euclidean", rests=True),
}


def path_of(
    motion: Motion,
    shape: tuple[int, int],
    n_frames: int,
    scene_shape: tuple[int, int],
    seed: int = 0,
    length_px: float = LENGTHS_PX[0],
    trembling: bool = False,
) -> Array:
    """Return the homographies of frames of (height, width), (T, 3, 3), to pixels of a scene, in whose middle the path lies."""
    rng, time, unit = np.random.default_rng(seed), np.linspace(0, 1, n_frames), shape[1] / WIDTH
    way = np.cumsum(np.clip((abs(time - 0.5) - RESTS) / GETS_GOING, 0, 1)) if motion.rests else time
    way, knots = way / way[-1], round(4 + n_frames / 400)
    phases = rng.uniform(0, 2 * np.pi, (2, len(PERIODS), 1))
    sines = np.sin(2 * np.pi * np.arange(n_frames) / np.array(PERIODS)[:, None] + phases).sum(axis=1)
    sines *= np.hypot(motion.shake_px, SHAKE_PX * trembling) * np.sqrt(2 / len(PERIODS))

    def smooth(std: float) -> Array:
        return np.asarray(CubicSpline(np.linspace(0, 1, knots), std * rng.standard_normal(knots))(way))

    room = np.maximum(np.subtract(scene_shape, shape)[::-1], 1)
    steady = np.outer(length_px * room / np.hypot(*room), way - 0.5)
    x, y = unit * motion.travels * (steady + np.stack([smooth(WOBBLE_PX), smooth(WOBBLE_PX)])) + sines
    roll = np.deg2rad(smooth(motion.roll_deg) + motion.through_deg * (way - 0.5))
    if motion.focal_px:
        to_scene = _seen(motion, x, y, roll, unit * motion.focal_px, way)
    else:
        scale = motion.zoom ** (0.5 * np.cos(2 * np.pi * way)) * (1 + smooth(motion.breathing))
        cos, sin, aspect, skew = scale * np.cos(roll), scale * np.sin(roll), smooth(motion.shear), smooth(motion.shear)
        across, down = (smooth(motion.keystone) / (shape[1] / 2) for _ in range(2))
        to_scene = _matrices(cos, -sin, x, sin, cos, y, 0, 0, 1)
        to_scene @= _matrices(1 + aspect, skew, 0, skew, 1 - aspect, 0, 0, 0, 1 + 0 * aspect)
        to_scene @= _matrices(1, 0, 0, 0, 1, 0, across, down, 1)
    to_scene = normalised(to_scene @ translation(*(1 - np.array(shape[::-1])) / 2))
    there = transform_points(to_scene, corners(shape)).reshape(-1, 2)
    return translation(*(np.array(scene_shape[::-1]) - 1 - there.min(axis=0) - there.max(axis=0)) / 2) @ to_scene


def _seen(motion: Motion, x: Array, y: Array, roll: Array, focal_px: float, way: Array) -> Array:
    """Return the homographies of a pinhole camera that looks at (x, y), in px from the middles of frames and scene.

    The scene is the plane z = 1, seen from where the world begins. A camera before a wall keeps its direction, but for its
    roll, and comes nearer.
    """
    across, down, zero = x / focal_px, y / focal_px, np.zeros_like(x)
    if motion.slant_deg:
        yaw, pitch = zero + np.deg2rad(motion.slant_deg), zero
    else:
        yaw = np.arctan(across)
        pitch = -np.arctan(down * np.cos(yaw))
    to_world = rotation_matrices(np.stack([zero, yaw, zero], axis=-1)) @ rotation_matrices(
        np.stack([pitch, zero, zero], axis=-1)
    )
    to_world = to_world @ rotation_matrices(np.stack([zero, zero, roll], axis=-1))
    camera = np.diag([focal_px, focal_px, 1.0])
    if motion.slant_deg:
        place = np.stack([across, down, zero + 1], axis=-1) - (1 - 0.2 * way)[:, None] * to_world[:, :, 2]
        # A ray from there meets the plane at place + ray * (1 - place_z) / ray_z.
        to_world = (1 - place[:, 2, None, None]) * to_world + place[:, :, None] * to_world[:, 2:]
    return np.asarray(camera @ to_world @ np.linalg.inv(camera))


def _matrices(*elements: ArrayLike) -> Array:
    """Return the matrices (T, 3, 3) of nine elements, numbers or (T,), row by row."""
    return np.stack(np.broadcast_arrays(*map(np.asarray, elements)), axis=-1).astype(np.float64).reshape(-1, 3, 3)
