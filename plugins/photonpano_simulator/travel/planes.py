"""Rectangles in space, and casting of rays on them.

Convention:
    Points of the world are (x, y, z) in m: x right, y down, z ahead. A pose (3, 4) maps them to points of the camera,
    X_c = R X_w + t, with the same axes; pixels are K X_c, integers are pixel centres. A point of a rectangle is
    corner + a along + b down with a and b from 0 to 1. It is seen from the side on which `along` points to the right and `down`
    down, and from the other side light passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray
from photonpano.compiling import compiled

_EDGE_ON = 1e-9  # a rectangle is not seen from its plane: the volume that it spans with the camera, relative to that of a box


@dataclass(frozen=True, slots=True, eq=False)
class Planes:
    """Rectangles, or the largest discs in them; they may move."""

    corner: FloatArray  # (P, 3), the top left corner in frame 0, in m
    along: FloatArray  # (P, 3), from there to the top right corner
    down: FloatArray  # (P, 3), from there to the bottom left corner
    velocity: FloatArray  # (P, 3), in m per frame
    is_disc: NDArray[np.bool_]  # (P,)

    def __len__(self) -> int:
        return len(self.corner)

    @property
    def radii(self) -> FloatArray:
        """Half axes of the discs as shares of their rectangles, (P, 2): at least (2, 2) for a rectangle, which cuts nothing."""
        sides = np.stack([np.linalg.norm(self.along, axis=1), np.linalg.norm(self.down, axis=1)], axis=1)
        return np.asarray(np.where(self.is_disc[:, None], sides.min(axis=1, keepdims=True) / sides / 2, 2.0))

    def maps(self, pose: FloatArray, matrix: FloatArray, frame: float) -> FloatArray:
        """Return maps of pixels to places on each plane at an instant: (P, 3, 3), from (x, y, 1) to (a, b, 1) / depth.

        The third row is the inverse depth along the optical axis: at most 0 for a plane that is not seen.
        """
        corner = self.corner + frame * self.velocity
        edges = np.stack([self.along, self.down, corner], axis=-1)
        edges = pose[:, :3] @ edges
        edges[..., 2] += pose[:, 3]
        scale = np.prod(np.linalg.norm(edges, axis=1), axis=1)
        seen = np.linalg.det(edges) > _EDGE_ON * scale
        found = np.zeros((len(self), 3, 3))
        found[seen] = np.linalg.inv(matrix @ edges[seen])
        return found

    def rows(self, pose: FloatArray, matrix: FloatArray, frame: float, height: int) -> NDArray[np.int64]:
        """Return the rows of a frame between which each plane may be seen: (P, 2), the first and the one after the last."""
        corner = self.corner + frame * self.velocity
        corners = np.stack([corner, corner + self.along, corner + self.down, corner + self.along + self.down], axis=1)
        seen = (corners @ pose[:, :3].T + pose[:, 3]) @ matrix.T
        ahead = seen[..., 2] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            y = seen[..., 1] / seen[..., 2]
        bounds = np.stack([np.floor(y.min(axis=1) - 0.5), np.ceil(y.max(axis=1) + 1.5)], axis=1)
        bounds[~ahead.all(axis=1)] = 0, height
        bounds[~ahead.any(axis=1)] = 0, 0
        rows: NDArray[np.int64] = np.clip(bounds, 0, height).astype(np.int64)
        return rows


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Planes with their textures."""

    planes: Planes
    textures: tuple[NDArray[np.float16], ...]  # the light that each sends to the camera, up to a factor: (height, width) each


@compiled
def trace(points: FloatArray, maps: FloatArray, radii: FloatArray, owner: NDArray[np.int32], inverse_depth: FloatArray) -> None:
    """Find the nearest plane on the rays of points of a frame, (N, 2) in px.

    Writes the index of the plane into `owner` (N,), -1 for none, and its inverse depth, in 1 / m, 0 for none.
    """
    for n in range(len(points)):
        x, y = points[n, 0], points[n, 1]
        nearest, found = 0.0, -1
        for p in range(len(maps)):
            m = maps[p]
            w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
            if w <= nearest:
                continue
            a, b = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w, (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w
            across, below = (a - 0.5) / radii[p, 0], (b - 0.5) / radii[p, 1]
            if 0 <= a <= 1 and 0 <= b <= 1 and across * across + below * below <= 1:
                nearest, found = w, p
        owner[n] = found
        inverse_depth[n] = nearest
