"""Light on a scene: lamps with soft shadows, and ambient light with occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano_simulator.travel.planes import Planes

_SPACING_M = 0.1  # distance between the places of a plane at which light is computed
_MOST_PLACES = 90  # places along a side, at most
_DIRECTIONS, _POINTS = 48, 16  # directions of ambient light, and points of each lamp
_GAP_M = 1e-3  # rays begin this far above their plane


@dataclass(frozen=True, slots=True)
class Lighting:
    """The light of a scene."""

    # (x, y, z) in m, radius in m, and light: at `reach_m` ahead of the lamp it is this, relative to the ambient light
    lamps: tuple[tuple[float, float, float, float, float], ...]
    ambient: float  # ambient light without occlusion
    shadow_m: float  # largest distance of ambient occlusion
    reach_m: float = 1.0  # distance at which the light of the lamps is given


def light_on(planes: Planes, index: int, lighting: Lighting) -> NDArray[np.float32]:
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
