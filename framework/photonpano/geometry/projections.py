"""Projections of a panorama: how directions in which a camera looks become points of a flat image, and back.

Convention:
    A ray is a direction (x, y, z) of the reference camera, x right, y down, z ahead, of any length. A point is (a, b), in
    radians for all projections but "planar". The ray of a point is `(p(a) r(b), q(b), s(a) r(b))`: it takes three
    multiplications once p, s of each column and q, r of each row are known.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from photonpano.values import FloatArray

ProjectionName: TypeAlias = Literal["planar", "cylindrical", "spherical"]


@dataclass(frozen=True, slots=True)
class Projection:
    """A projection.

    Attributes:
        across: returns p and s for a.
        down: returns q and r for b.
        points: returns the points of (..., 3) rays: (..., 2).
    """

    across: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    down: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    points: Callable[[FloatArray], FloatArray]

    def rays(self, points: FloatArray) -> FloatArray:
        """Return the rays of (..., 2) points: (..., 3)."""
        (p, s), (q, r) = self.across(points[..., 0]), self.down(points[..., 1])
        return np.stack([p * r, np.broadcast_to(q, p.shape), s * r], axis=-1)


def _straight(coordinates: FloatArray) -> tuple[FloatArray, FloatArray]:
    return coordinates, np.ones_like(coordinates)


def _round(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.sin(angles), np.cos(angles)


def _on_plane(rays: FloatArray) -> FloatArray:
    ahead = rays[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(ahead > 0, rays[..., :2] / ahead, np.nan)


def _on_cylinder(rays: FloatArray) -> FloatArray:
    x, y, z = np.moveaxis(rays, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([np.arctan2(x, z), y / np.hypot(x, z)], axis=-1)


def _on_sphere(rays: FloatArray) -> FloatArray:
    x, y, z = np.moveaxis(rays, -1, 0)
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], axis=-1)


# The projections by name. The rays of "planar" are homogeneous pixels of the reference frame, not directions.
PROJECTIONS: dict[str, Projection] = {
    "planar": Projection(_straight, _straight, _on_plane),
    "cylindrical": Projection(_round, _straight, _on_cylinder),
    "spherical": Projection(_round, _round, _on_sphere),
}
