"""Build the scenes that a camera travels through: rectangles in space that a file describes, drawn, and lit by lamps.

Convention:
    Metres; x right, y down, z ahead. A rectangle is seen from the side on which `along` points to the right and `down` down.

The file of a scene has `things`, `groups` of things that stand together, `pictures` (see `scenes`), where a camera looks
(`middle`) and may be (`free`, the smallest and the largest coordinates), and its `light`. A thing is a mapping with these keys,
whose numbers are written as in `scenes`:

    sheet, along, down: the top left corner of a rectangle, and the ways from there to the top right and the bottom left
    box, size: the middle of the base of a box without a bottom, and its width, height and depth
    group, things: the name of a group, or things
    at, each: where the thing stands, or the places of several
    yaw, scale: its turn about the vertical in degrees, to the right, and a factor of its size
    draw, front, top: the picture on it, or several of which one is taken; that of the side to the camera; that on top
    pick: see `scenes`
    units: units of the picture in a metre, 1000 by default
    detail: texels along a pixel of the camera
    glow: light that it sends by itself, relative to its reflectance in full light
    photo: the side, `along` or `down`, that is fitted to a photograph which is hung there
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano.photometry import srgb_to_linear
from photonpano_simulator.camera import Draw, generator, texture_of
from photonpano_simulator.scenes import Chance, Drawing, Names, photograph, pictures_of, read_scene
from photonpano_simulator.travel_config import TravelConfig, WorldObject
from photonpano_simulator.travel_planes import Planes, Scene

_SPACING_M = 0.1  # distance between the places of a plane at which light is computed
_MOST_PLACES = 90  # places along a side, at most
_DIRECTIONS, _POINTS = 48, 16  # directions of ambient light, and points of each lamp
_GAP_M = 1e-3  # rays begin this far above their plane


@dataclass(frozen=True, slots=True)
class _Lighting:
    """The light of a scene."""

    # (x, y, z) in m, radius in m, and light: at `reach_m` ahead of the lamp it is this, relative to the ambient light
    lamps: tuple[tuple[float, float, float, float, float], ...]
    ambient: float  # ambient light without occlusion
    shadow_m: float  # largest distance of ambient occlusion
    reach_m: float = 1.0  # distance at which the light of the lamps is given


def _light_on(planes: Planes, index: int, lighting: _Lighting) -> NDArray[np.float32]:
    """Return the light on a plane, on a grid of places that covers it: (n, m)."""
    along, down = planes.along[index], planes.down[index]
    counts = [int(np.clip(np.ceil(np.linalg.norm(side) / _SPACING_M), 2, _MOST_PLACES)) for side in (along, down)]
    towards = -np.cross(along, down)
    towards /= np.linalg.norm(towards)
    a, b = ((np.arange(count) + 0.5) / count for count in counts)
    places = planes.corner[index] + _GAP_M * towards + a[None, :, None] * along + b[:, None, None] * down
    points = places.reshape(-1, 3)
    inverses = np.linalg.inv(np.stack([planes.along, planes.down, np.cross(planes.along, planes.down)], axis=-1))
    open_share = np.zeros(len(points))
    # Points of a sphere that touches the plane lie in directions that are denser where the light counts more: by the cosine.
    for direction in _sphere(_DIRECTIONS) + towards:
        way = direction * (lighting.shadow_m / np.linalg.norm(direction))
        _unblocked(points, np.broadcast_to(way, points.shape), planes.corner, inverses, open_share)
    light = lighting.ambient * open_share / _DIRECTIONS
    for x, y, z, radius, power in lighting.lamps:
        for offset in _sphere(_POINTS):
            ways = np.array([x, y, z]) + radius * offset - points
            squared = (ways**2).sum(axis=1)
            cosine = np.maximum(ways @ towards, 0) / np.sqrt(squared)
            reached = np.zeros(len(points))
            _unblocked(points, ways, planes.corner, inverses, reached)
            light += power * lighting.reach_m**2 / _POINTS * reached * cosine / squared
    return light.reshape(counts[1], counts[0]).astype(np.float32)


@compiled
def _unblocked(points: FloatArray, ways: FloatArray, corners: FloatArray, inverses: FloatArray, total: FloatArray) -> None:
    """Add 1 for each point (N, 3) from which a segment (N, 3) meets no plane."""
    for n in range(len(points)):
        is_free = True
        for p in range(len(corners)):
            m = inverses[p]
            x, y, z = points[n, 0] - corners[p, 0], points[n, 1] - corners[p, 1], points[n, 2] - corners[p, 2]
            height = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
            climb = m[2, 0] * ways[n, 0] + m[2, 1] * ways[n, 1] + m[2, 2] * ways[n, 2]
            if height * climb >= 0 or abs(height) >= abs(climb):
                continue
            t = -height / climb
            x, y, z = x + t * ways[n, 0], y + t * ways[n, 1], z + t * ways[n, 2]
            a, b = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z, m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
            if 0 <= a <= 1 and 0 <= b <= 1:
                is_free = False
                break
        if is_free:
            total[n] += 1.0


def _sphere(count: int) -> FloatArray:
    """Return points on a unit sphere, evenly: (N, 3)."""
    steps = np.arange(count) + 0.5
    y, turn = 1 - 2 * steps / count, np.pi * (3 - 5**0.5) * steps
    radius = np.sqrt(1 - y**2)
    return np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=1)


_NEAREST_M = 0.6  # textures are as fine as pixels at the distance of their plane, but not finer than pixels at this distance
_MOST_TEXELS = 24_000_000  # beyond, all textures are coarser; texels take 2 bytes each in the truth
_DARKEST = 0.004  # reflectance below which nothing is painted, so that every place gives some light


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Sheet:
    """A rectangle that is to be drawn: its picture by name, or linear reflectance."""

    corner: FloatArray
    along: FloatArray
    down: FloatArray
    picture: str | NDArray[np.float32]
    names: Names
    units: float
    detail: float
    glow: float

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in m."""
        return float(np.linalg.norm(self.along)), float(np.linalg.norm(self.down))


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """Where a group stands: its points are `axes` times the points of its things, plus `origin`."""

    axes: FloatArray
    origin: FloatArray


class Stage:
    """A scene that is placed, and not drawn yet.

    Attributes:
        middle: (3,), where a camera looks by default, in m.
        free: (2, 3), the smallest and the largest coordinates that a camera may have.
    """

    def __init__(self, config: TravelConfig) -> None:
        self._seed, self._eye, self._focal_px = config.scene.seed, np.array(config.path.centre), config.focal_px
        self._kind, self._file = config.scene.kind, read_scene(config.scene.kind)
        self._chance = Chance(generator(self._seed, Draw.SCENE))
        photo = None if config.scene.photo is None else photograph(config.scene.photo)
        sheets = list(self._placed(self._file["things"], _Place(np.eye(3), np.zeros(3)), {}))
        self._sheets = [sheet if photo is None or side is None else _hung(sheet, side, photo) for sheet, side in sheets]
        corner, along, down = (np.stack([getattr(each, name) for each in self._sheets]) for name in ("corner", "along", "down"))
        self.planes = Planes(corner, along, down, np.zeros_like(corner), np.zeros(len(corner), bool))
        self.middle: FloatArray = np.array(self._file["middle"])
        self.free: FloatArray = np.array(self._file["free"])

    def drawn(self, threads: int) -> Scene:
        """Draw and light the scene, in some threads."""
        lighting = _Lighting(**self._file["light"]) if "light" in self._file else None
        texels = np.array([self._texel(each) for each in self._sheets])
        areas = np.array([np.prod(each.size) for each in self._sheets])
        texels *= max(1.0, float((areas / texels**2).sum() / _MOST_TEXELS) ** 0.5)

        def texture(index: int) -> NDArray[np.float16]:
            sheet = self._sheets[index]
            light = np.ones((1, 1), np.float32) if lighting is None else _light_on(self.planes, index, lighting)
            reflectance = self._drawn(sheet, index, float(texels[index]))
            smooth = np.asarray(cv2.resize(light, reflectance.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
            # Rounded as the truth keeps it.
            return np.asarray(np.maximum(reflectance, _DARKEST) * (smooth + np.float32(sheet.glow)), np.float16)

        with ThreadPoolExecutor(max(1, threads)) as pool:
            return Scene(self.planes, tuple(pool.map(texture, range(len(self._sheets)))))

    def _placed(self, things: Sequence[Mapping[str, Any]], place: _Place, names: Names) -> Iterator[tuple[_Sheet, str | None]]:
        """Yield the rectangles of some things, each with the side that a photograph changes."""
        for thing in things:
            for at in thing.get("each", [thing.get("at", (0, 0, 0))]):
                now = self._chance.picked(names, thing["pick"]) if "pick" in thing else names
                yaw, scale = (self._chance.number(thing.get(key, usual), now) for key, usual in (("yaw", 0), ("scale", 1)))
                cos, sin = np.cos(np.deg2rad(yaw)), np.sin(np.deg2rad(yaw))
                axes = place.axes @ (scale * np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]))
                there = _Place(axes, place.origin + place.axes @ (scale * self._point(at, now)))
                if "box" in thing:
                    base = there.origin + place.axes @ self._point(thing["box"], now)
                    yield from self._box(thing, _Place(axes, base), now)
                elif "sheet" in thing:
                    corner, along, down = (self._point(thing[key], now) for key in ("sheet", "along", "down"))
                    yield self._sheet(thing, there, (corner, along, down), now), thing.get("photo")
                else:
                    inner = self._file["groups"][thing["group"]] if "group" in thing else thing["things"]
                    yield from self._placed(inner, there, now)

    def _point(self, written: Sequence[Any], names: Names) -> FloatArray:
        return np.array([self._chance.number(each, names) for each in written], np.float64)

    def _sheet(
        self, thing: Mapping[str, Any], place: _Place, edges: tuple[FloatArray, ...], names: Names, draw: Any = None
    ) -> _Sheet:
        corner, along, down = edges
        draw = draw or thing["draw"]
        return _Sheet(
            corner=place.axes @ corner + place.origin,
            along=place.axes @ along,
            down=place.axes @ down,
            picture=draw if isinstance(draw, str) else self._chance.one(draw),
            names=names,
            units=thing.get("units", 1000.0),
            detail=thing.get("detail", 1.0),
            glow=thing.get("glow", 0.0),
        )

    def _box(self, thing: Mapping[str, Any], place: _Place, names: Names) -> Iterator[tuple[_Sheet, None]]:
        """Yield the sides of a box and its top."""
        width, height, depth = self._point(thing["size"], names)
        draw = thing["draw"] if isinstance(thing["draw"], str) else self._chance.one(thing["draw"])
        x, y, z = np.array([width, 0, 0]), np.array([0, height, 0]), np.array([0, 0, depth])
        near, far = np.array([-width / 2, -height, -depth / 2]), np.array([width / 2, -height, depth / 2])
        for picture, *edges in (
            (thing.get("front", draw), near, x, y),
            (draw, far, -x, y),
            (draw, near + z, -z, y),
            (draw, far - z, z, y),
            (thing.get("top", draw), near + z, x, -z),
        ):
            yield self._sheet(thing, place, tuple(edges), names, picture), None

    def _texel(self, sheet: _Sheet) -> float:
        """Return the size of the texels of a sheet, in m."""
        axes = np.stack([sheet.along, sheet.down])
        places = np.clip(axes @ (self._eye - sheet.corner) / (axes**2).sum(axis=1), 0, 1)
        distance = float(np.linalg.norm(sheet.corner + places @ axes - self._eye))
        return max(distance, _NEAREST_M) / (self._focal_px * sheet.detail)

    def _drawn(self, sheet: _Sheet, index: int, texel: float) -> NDArray[np.float32]:
        """Return the linear reflectance of a sheet."""
        width, height = sheet.size
        shape = max(2, round(height / texel)), max(2, round(width / texel))
        if isinstance(sheet.picture, np.ndarray):
            if shape[0] >= sheet.picture.shape[0]:
                return sheet.picture
            return np.asarray(cv2.resize(sheet.picture, shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
        rng = generator(self._seed, Draw.TEXTURE, index)
        drawing = Drawing(shape, height * sheet.units, pictures_of(self._kind), rng)
        return srgb_to_linear(drawing.finished(sheet.picture, sheet.names))


def _hung(sheet: _Sheet, side: str, photo: NDArray[np.float32]) -> _Sheet:
    """Return a sheet with a photograph on it, to whose proportions one side is fitted; its middle stays."""
    ratio, (width, height) = photo.shape[0] / photo.shape[1], sheet.size
    fitted = getattr(sheet, side) * (height / ratio / width if side == "along" else width * ratio / height)
    corner = sheet.corner + (getattr(sheet, side) - fitted) / 2
    return replace(sheet, corner=corner, picture=photo, **{side: fitted})


def with_objects(
    scene: Scene,
    objects: tuple[WorldObject, ...],
    pose: FloatArray,
    *,
    matrix: FloatArray,
    frame_shape: tuple[int, int],
    mean: float,
) -> Scene:
    """Add what moves on its own, and faces the first frame, of pose (3, 4); `mean` is that of the light of the scene."""
    if not objects:
        return scene
    height, width = frame_shape
    focal, to_world = matrix[0, 0], pose[:, :3].T
    corner, along, down, velocity, textures = [], [], [], [], []
    for each in objects:
        metres = each.distance_m / focal
        size_px = np.array(each.size) * (width, height)
        left, top = np.array(each.at) * (width, height) - 0.5 - size_px / 2
        corner.append(to_world @ (each.distance_m * np.linalg.inv(matrix) @ (left, top, 1) - pose[:, 3]))
        along.append(to_world @ (size_px[0] * metres, 0, 0))
        down.append(to_world @ (0, size_px[1] * metres, 0))
        velocity.append(to_world @ (each.moves_px[0] * metres, each.moves_px[1] * metres, 0))
        textures.append((texture_of(size_px, each.seed) * np.float32(mean * each.flux)).astype(np.float16))
    still = scene.planes
    planes = Planes(
        np.concatenate([still.corner, corner]),
        np.concatenate([still.along, along]),
        np.concatenate([still.down, down]),
        np.concatenate([still.velocity, velocity]),
        np.concatenate([still.is_disc, [each.shape == "disc" for each in objects]]),
    )
    return replace(scene, planes=planes, textures=(*scene.textures, *textures))
