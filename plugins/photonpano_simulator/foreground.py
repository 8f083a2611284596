"""Draw what stands and walks before the scene at a distance: boards, and figures of people.

Convention:
    Points of the world are (x, y, z) in m, x right, y down, z ahead of a camera that looks at the middle of the scene, and
    0 is where the camera is in the first frame. Pixels are (x, y), integers are centres, sizes of textures are (width, height).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, InputError
from photonpano.compiling import compiled
from photonpano_simulator.camera import Draw, camera, generator, outline, pixel_grid, texture_of, undistorted
from photonpano_simulator.config import Clutter, People, SimulationConfig
from photonpano_simulator.paths import camera_positions, pace

_FINEST = 4096  # largest side of a texture, in texels
_SAMPLES, _COARSE = 100, 4  # frames, and px between pixels, in which the share that people or boards cover is measured
_SIZES = np.geomspace(0.02, 8.0, 16)  # of people and boards that are tried, in heights of a frame
_HALVINGS = 10  # between two of them
_PAUSES = 3  # of each person during a capture
_SWING, _STRIDE = 0.4, 0.8  # amplitude of the legs in radians, and length of two steps in heights of a person
_MARGIN = 1.1  # people turn round this far outside, in fields of view
_PERSON = 0.6  # width of the picture of a person in heights
_BODY = ((0.5, 0.09, 0.5, 0.09, 0.08), (0.5, 0.27, 0.5, 0.46, 0.12))
"""Head and trunk of a person as capsules: two points (x, y) and a radius, in heights; x = 0.5 is the middle."""
_LIMBS = ((0.5, 0.5, 0.44, 0.055, 1.0), (0.5, 0.22, 0.32, 0.045, -0.8))
"""Legs and arms: where they hang, their length and radius in heights, and their swing relative to that of the legs."""
_NO_LIMBS = np.zeros((0, 5))
_BLANK = np.ones((1, 1), np.float32)


@dataclass(frozen=True, kw_only=True)
class Cover:
    """Something flat and upright."""

    kind: str  # board or person
    size: tuple[int, int]  # of its texture
    azimuth: FloatArray  # (T,) of its middle in radians, to the right
    elevation: float  # in radians, down
    distance_m: float  # of its middle along the ground
    size_m: tuple[float, float]  # width and height
    slant: float = 0.0  # turn about its upright axis in radians; at 0 it faces the first camera
    swing: FloatArray | None = None  # (T,) of the legs of a person, in radians
    texture: NDArray[np.float32] = field(default_factory=lambda: _BLANK)  # flux, (height, width)

    def plane(self, frame: int) -> FloatArray:
        """Return the map of its texels (x, y, 1) to the world: (3, 3)."""
        azimuth = self.azimuth[frame]
        middle = self.distance_m * np.array([np.sin(azimuth), np.tan(self.elevation), np.cos(azimuth)])
        width, height = self.size
        across = self.size_m[0] / width * np.array([np.cos(azimuth + self.slant), 0, -np.sin(azimuth + self.slant)])
        down = np.array([0, self.size_m[1] / height, 0])
        return np.stack([across, down, middle - across * (width - 1) / 2 - down * (height - 1) / 2], axis=1)

    def capsules(self, frame: int) -> FloatArray:
        """Return head, trunk, legs and arms of a person, (N, 5), in texels; none of a board."""
        if self.swing is None:
            return _NO_LIMBS
        parts = list(_BODY)
        for x, y, length, radius, share in _LIMBS:
            side, down = length * np.sin(share * self.swing[frame]), length * np.cos(share * self.swing[frame])
            parts += [(x, y, x + side, y + down, radius), (x, y, x - side, y + down, radius)]
        width, height = self.size
        return np.array(parts) * height - np.array([1, 0, 1, 0, 0]) * (height - width) / 2


class _Grid:
    """Pixels (2, H, W) of a lens without distortion, and how far each column and each row reaches."""

    def __init__(self, points: FloatArray) -> None:
        self.points = np.ascontiguousarray(points)
        self.leftmost, self.rightmost = points[0].min(axis=0), points[0].max(axis=0)
        self.highest, self.lowest = points[1].min(axis=1), points[1].max(axis=1)


class _Seen(NamedTuple):
    """A box of pixels; and for each the share that a cover takes, the texel that is seen, and its depth, (h, w) each."""

    box: tuple[slice, slice]
    share: NDArray[np.float32]
    across: NDArray[np.float32]
    down: NDArray[np.float32]
    depth: NDArray[np.float32]


class Foreground:
    """The boards and people of a capture, seen by its camera.

    Attributes:
        kinds: board or person, of each cover in the order of its labels, which begin at 1.
    """

    def __init__(self, config: SimulationConfig, rotations: FloatArray | None, flux: float) -> None:
        covers: list[Cover] = []
        if rotations is not None and (config.boards or config.clutter or config.people):
            self._positions = camera_positions(config.path, config.n_frames)
            self._matrix, self._rotations = camera(config).matrix, rotations
            self._grid = _Grid(np.moveaxis(undistorted(config, pixel_grid(config.frame_shape)), -1, 0))
            for board in config.boards:
                texel = max(board.distance_m / config.focal_length_px, max(board.size_m) / _FINEST)
                size = max(1, round(board.size_m[0] / texel)), max(1, round(board.size_m[1] / texel))
                azimuth, elevation, slant = np.deg2rad((*board.at_deg, board.slant_deg)).tolist()
                ahead = np.full(config.n_frames, azimuth)
                texture = texture_of(np.array(size), board.seed) * np.float32(flux * board.flux)
                covers.append(
                    Cover(
                        kind="board",
                        size=size,
                        azimuth=ahead,
                        elevation=elevation,
                        distance_m=board.distance_m,
                        size_m=board.size_m,
                        slant=slant,
                        swing=None,
                        texture=texture,
                    )
                )
            if config.clutter is not None:
                clutter = _clutter(config, config.clutter, rotations)
                covers += self._sized(clutter, config.clutter.share, "clutter", "boards", flux)
            if config.people is not None:
                people = _people(config, config.people, rotations)
                covers += self._sized(people, config.people.share, "people", "people", flux)
        self.kinds = [cover.kind for cover in covers]
        self._covers = sorted(enumerate(covers, 1), key=lambda each: -each[1].distance_m)

    def draw(self, view: NDArray[np.float32], frame: int) -> None:
        """Replace the flux of the pixels, or of the parts of pixels, that are covered in a frame; `view` is (H, W)."""
        for _, cover in self._covers:
            if (seen := self._seen(cover, frame, self._grid)) is not None:
                flux = cv2.remap(cover.texture, seen.across, seen.down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                view[seen.box] += seen.share * (flux - view[seen.box])

    def mark(self, labels: NDArray[np.uint8], depth: NDArray[np.float32], frame: int) -> None:
        """Write which cover takes more than half of each pixel, and its depth along the optical axis in m: (H, W) each."""
        for label, cover in self._covers:
            if (seen := self._seen(cover, frame, self._grid)) is not None:
                there = seen.share > 0.5
                labels[seen.box][there] = label
                depth[seen.box][there] = seen.depth[there]

    def _seen(self, cover: Cover, frame: int, grid: _Grid) -> _Seen | None:
        """Return what pixels see of a cover."""
        plane = cover.plane(frame)
        plane[:, 2] -= self._positions[frame]
        to_pixels = self._matrix @ self._rotations[frame].T @ plane
        width, height = cover.size
        edges = to_pixels @ np.array([[-1, width, -1, width], [-1, -1, height, height], [1, 1, 1, 1]])
        if edges[2].max() <= 0 or abs(np.linalg.det(to_pixels)) < 1e-300:
            return None
        box = np.s_[:, :]
        if edges[2].min() > 0:
            (left, top), (right, bottom) = (edges[:2] / edges[2]).min(axis=1), (edges[:2] / edges[2]).max(axis=1)
            columns = np.flatnonzero((grid.rightmost >= left) & (grid.leftmost <= right))
            rows = np.flatnonzero((grid.lowest >= top) & (grid.highest <= bottom))
            if not (len(columns) and len(rows)):
                return None
            box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        near = grid.points[:, *box]
        found = np.empty((4, *near.shape[1:]), np.float32)
        _look(near, np.linalg.inv(to_pixels), cover.capsules(frame), width, height, *found)
        return _Seen(box, *found)

    def _sized(
        self, make: Callable[[float, float], list[Cover]], share: float, key: str, noun: str, flux: float
    ) -> list[Cover]:
        """Return covers of the size at which they cover a share of the pixels; `make` takes this size, and the flux or 0."""
        grid = _Grid(self._grid.points[:, _COARSE // 2 :: _COARSE, _COARSE // 2 :: _COARSE])
        frames = np.unique(np.linspace(0, len(self._positions) - 1, _SAMPLES).astype(int))

        def covered(size: float) -> float:
            covers, total = make(size, 0.0), 0
            for frame in frames:
                hidden = np.zeros(grid.points.shape[1:], bool)
                for cover in covers:
                    if (seen := self._seen(cover, frame, grid)) is not None:
                        hidden[seen.box] |= seen.share > 0.5
                total += hidden.sum()
            return total / (len(frames) * hidden.size)

        # People who are too large seldom are in the frame: their share may decrease again.
        reached = []
        for size in _SIZES:
            reached.append(covered(size))
            if reached[-1] >= share:
                break
        else:
            raise InputError(
                f"{noun} cover at most {max(reached):.0%} of the pixels, and {key}.share is {share:.0%}; raise {key}.number, "
                f"or lower {key}.share"
            )
        low, high = size * _SIZES[0] / _SIZES[1], size
        for _ in range(_HALVINGS):
            middle = (low * high) ** 0.5
            low, high = (middle, high) if covered(middle) < share else (low, middle)
        return make(high, flux)


def _clutter(config: SimulationConfig, clutter: Clutter, rotations: FloatArray) -> Callable[[float, float], list[Cover]]:
    """Return what makes boards all along the path from their size in heights of a frame, and their flux."""
    rng, n = generator(clutter.seed, Draw.CLUTTER), clutter.number
    yaw, level, field_of_view = _gaze(config, rotations)
    low, span = yaw.min() - field_of_view / 2, min(np.ptp(yaw) + field_of_view, 2 * np.pi)
    azimuths = low + span * (np.arange(n) + rng.uniform(0.2, 0.8, n)) / n
    elevations = level + rng.uniform(-0.3, 0.3, n) * config.frame_shape[0] / config.focal_length_px
    distances = 1 / rng.uniform(1 / clutter.farthest_m, 1 / clutter.nearest_m, n)
    shapes, slants = rng.uniform((0.5, 0.7), (1.2, 1.3), (n, 2)), rng.uniform(-0.5, 0.5, n)
    light = rng.uniform(0.5, 1.5, n)

    def make(size: float, flux: float) -> list[Cover]:
        covers = []
        for place, (azimuth, distance) in enumerate(zip(azimuths, distances, strict=True)):
            texels, metres = _sides(size * shapes[place], float(distance), config)
            texture = (
                texture_of(np.array(texels), clutter.seed * 100 + place) * np.float32(flux * light[place]) if flux else _BLANK
            )
            ahead, elevation, slant = np.full(config.n_frames, azimuth), float(elevations[place]), float(slants[place])
            covers.append(
                Cover(
                    kind="board",
                    size=texels,
                    azimuth=ahead,
                    elevation=elevation,
                    distance_m=float(distance),
                    size_m=metres,
                    slant=slant,
                    swing=None,
                    texture=texture,
                )
            )
        return covers

    return make


def _people(config: SimulationConfig, people: People, rotations: FloatArray) -> Callable[[float, float], list[Cover]]:
    """Return what makes people who walk to and fro from their height in heights of a frame, and the flux of the scene.

    Who is further outside than the margin comes in again from the other side.
    """
    rng, n, n_frames = generator(people.seed, Draw.PEOPLE), people.number, config.n_frames
    yaw, level, field_of_view = _gaze(config, rotations)
    elevations = level + rng.uniform(-0.1, 0.1, n) * config.frame_shape[0] / config.focal_length_px
    distances, heights = rng.uniform(people.nearest_m, people.farthest_m, n), rng.uniform(0.85, 1.15, n)
    starts, speeds = (np.arange(n) + rng.uniform(0.2, 0.8, n)) / n, people.speed_px * rng.uniform(0.8, 1.2, n)
    speeds[1::2] *= -1
    light = rng.uniform(0.4, 1.6, (n, 3))  # of head, coat and trousers
    begins = (np.arange(_PAUSES) + rng.uniform(0, 1 - people.pauses, (n, _PAUSES))) / _PAUSES
    pauses = [[(start, start + people.pauses / _PAUSES) for start in begin if people.pauses] for begin in begins]
    paces = [pace(each, n_frames) for each in pauses]
    walks = np.cumsum(paces, axis=1) * speeds[:, None]

    def make(size: float, flux: float) -> list[Cover]:
        covers = []
        for place, distance in enumerate(distances):
            height = size * heights[place]
            texels, metres = _sides(np.array([_PERSON * height, height]), float(distance), config)
            period = _MARGIN * field_of_view + texels[0] / config.focal_length_px
            beside = starts[place] * period + walks[place] / config.focal_length_px - yaw
            azimuth = yaw + np.mod(beside, period) - period / 2
            swing = _SWING * paces[place] * np.sin(2 * np.pi * walks[place] / (_STRIDE * texels[1]))
            texture = _clothes(texels, light[place], people.seed * 100 + place) * np.float32(flux) if flux else _BLANK
            elevation = float(elevations[place])
            covers.append(
                Cover(
                    kind="person",
                    size=texels,
                    azimuth=azimuth,
                    elevation=elevation,
                    distance_m=float(distance),
                    size_m=metres,
                    slant=0.0,
                    swing=swing,
                    texture=texture,
                )
            )
        return covers

    return make


def _sides(heights: FloatArray, distance_m: float, config: SimulationConfig) -> tuple[tuple[int, int], tuple[float, float]]:
    """Return width and height in texels and in m of what is (2,) heights of a frame wide and high at a distance."""
    pixels = np.maximum(1, np.round(heights * config.frame_shape[0]))
    metres = pixels * distance_m / config.focal_length_px
    return (int(pixels[0]), int(pixels[1])), (float(metres[0]), float(metres[1]))


def _gaze(config: SimulationConfig, rotations: FloatArray) -> tuple[FloatArray, float, float]:
    """Return how far to the right the camera looks in each frame (T,), how far down on average, and its field of view."""
    x, y, z = rotations[:, :, 2].T
    around = (outline(config)[:, 0] - camera(config).centre_px[0]) / config.focal_length_px
    field_of_view = float(np.arctan(around.max()) - np.arctan(around.min()))
    return np.unwrap(np.arctan2(x, z)), float(np.arcsin(np.clip(y, -1, 1)).mean()), field_of_view


def _clothes(size: tuple[int, int], light: FloatArray, seed: int) -> NDArray[np.float32]:
    """Return the texture of a person with a head, a coat and trousers of their own light: (height, width)."""
    rows = np.linspace(0, 1, size[1])[:, None]
    return texture_of(np.array(size), seed) * np.select([rows < 0.17, rows < 0.5], light[:2], light[2]).astype(np.float32)


@compiled
def _look(  # noqa: PLR0913, PLR0917
    points: FloatArray,
    to_texels: FloatArray,
    capsules: FloatArray,
    width: int,
    height: int,
    share: NDArray[np.float32],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    depth: NDArray[np.float32],
) -> None:
    """Write what pixels `points` (2, H, W) see of a plane: the share that it takes, the texel (across, down), its depth.

    `to_texels` is the inverse of K R^T [a, b, o - c], which maps texels to pixels times their depth. The plane is taken where
    it lies in one of the capsules, or within `width` and `height` if there are none; its edge is a ramp of one texel.
    """
    sides = capsules[:, 2:4] - capsules[:, :2]
    per_square = 1 / np.maximum((sides * sides).sum(axis=1), 1e-12)
    for i in range(points.shape[1]):
        xs, ys = points[0, i], points[1, i]
        for j in range(len(xs)):
            x, y = xs[j], ys[j]
            nearness = to_texels[2, 0] * x + to_texels[2, 1] * y + to_texels[2, 2]
            if nearness <= 0:
                share[i, j], across[i, j], down[i, j], depth[i, j] = 0.0, 0.0, 0.0, np.inf
                continue
            u = (to_texels[0, 0] * x + to_texels[0, 1] * y + to_texels[0, 2]) / nearness
            v = (to_texels[1, 0] * x + to_texels[1, 1] * y + to_texels[1, 2]) / nearness
            outside = max(max(-0.5 - u, u - width + 0.5), max(-0.5 - v, v - height + 0.5))
            if len(capsules) and outside < 0.5:
                outside = 0.5
                for k in range(len(capsules)):
                    x0, y0, radius = capsules[k, 0], capsules[k, 1], capsules[k, 4]
                    dx, dy = capsules[k, 2] - x0, capsules[k, 3] - y0
                    along = min(max(((u - x0) * dx + (v - y0) * dy) * per_square[k], 0.0), 1.0)
                    beside, below = u - x0 - along * dx, v - y0 - along * dy
                    squared = beside * beside + below * below
                    if squared < (radius + 0.5) ** 2:
                        outside = min(outside, np.sqrt(squared) - radius)
            share[i, j] = min(max(0.5 - outside, 0.0), 1.0)
            across[i, j], down[i, j], depth[i, j] = u, v, 1 / nearness
