"""The canvas of a panorama: its size, its projection, and the map to its pixels.

Convention:
    A ray is a direction (x, y, z) of the reference camera, x right, y down, z ahead, of any length. A point is (a, b), near
    (0, 0) in radians for all projections but "planar". The ray of a point is `(p(a) r(b), q(b), s(a) r(b) + t(b))`: it takes
    three multiplications once p, s of each column and q, r, t of each row are known.

The canvas of a camera that turns is what its frames cover of a cylinder, a sphere, or another surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from photonpano.geometry.camera import Camera, nearest_rotations
from photonpano.geometry.homographies import BLOCK_FRAMES, corners, rescaling, transform_points, translation
from photonpano.values import FloatArray, Homography

ProjectionName: TypeAlias = Literal["planar", "cylindrical", "spherical", "mercator", "panini", "stereographic"]
_Terms: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
_SIDE_DIRECTIONS = 65  # directions along each side of what frames cover, whose places on a canvas are its bounds


@dataclass(frozen=True, slots=True)
class Projection:
    """A projection."""

    across: _Terms  # returns p and s for a, and nothing of account
    down: _Terms  # returns q, r and t for b
    points: Callable[[FloatArray], FloatArray]  # returns the points of (..., 3) rays: (..., 2)
    periodic: bool = False  # whether a is an angle, so that a full turn comes back to where it began
    # how far from ahead it goes along a, and along b, in degrees: further out, it grows without bounds
    widest: tuple[float, float] = (np.inf, np.inf)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return the rays of (..., 2) points: (..., 3)."""
        (p, s, _), (q, r, t) = self.across(points[..., 0]), self.down(points[..., 1])
        return np.stack([p * r, np.broadcast_to(q, p.shape), s * r + t], axis=-1)

    def bounds(self, a: tuple[float, float], b: tuple[float, float]) -> FloatArray:
        """Return the lowest and the highest point that a box of angles reaches, in radians: (2, 2)."""
        across, down = (np.linspace(*each, _SIDE_DIRECTIONS) for each in ((0.0, 0.0) if self.periodic else a, b))
        angles = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        points = self.points(PROJECTIONS["spherical"].rays(angles))
        found = np.stack([points.min(axis=0), points.max(axis=0)])
        if self.periodic:
            found[:, 0] = a
        return found


def _flat(coordinates: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return coordinates, np.ones_like(coordinates), np.zeros_like(coordinates)


def _round(angles: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return np.sin(angles), np.cos(angles), np.zeros_like(angles)


def _from_behind(coordinates: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Look at a cylinder, or a sphere, from behind its middle."""
    return coordinates, 1 - coordinates**2 / 4, np.zeros_like(coordinates)


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


def _on_mercator(rays: FloatArray) -> FloatArray:
    across, down = np.moveaxis(_on_cylinder(rays), -1, 0)
    return np.stack([across, np.arcsinh(down)], axis=-1)


def _on_panini(rays: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return 2 * rays[..., :2] / (np.hypot(rays[..., 0], rays[..., 2]) + rays[..., 2])[..., None]


def _stereographic(rays: FloatArray) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(2 * rays[..., :2] / (np.linalg.norm(rays, axis=-1) + rays[..., 2])[..., None])


# The projections by name. The rays of "planar" are homogeneous pixels of the reference frame, not directions.
PROJECTIONS: dict[str, Projection] = {
    "planar": Projection(_flat, _flat, _on_plane),
    "cylindrical": Projection(_round, _flat, _on_cylinder, periodic=True, widest=(np.inf, 80)),
    "spherical": Projection(_round, _round, _on_sphere, periodic=True),
    "mercator": Projection(_round, lambda b: _flat(np.sinh(b)), _on_mercator, periodic=True, widest=(np.inf, 85)),
    "panini": Projection(_from_behind, _flat, _on_panini, widest=(150, 80)),
    "stereographic": Projection(
        _from_behind, lambda b: (b, np.ones_like(b), -(b**2) / 4), _stereographic, widest=(150, np.inf)
    ),
}


# x0, y0, x1, y1 in pixels of the reference frame: columns x0 to x1 - 1 and rows y0 to y1 - 1.
Box: TypeAlias = tuple[int, int, int, int]
Extent: TypeAlias = Literal["panorama", "reference"] | Box  # what a canvas holds: every frame, the reference frame, or a box


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """The pixel grid of a panorama."""

    height: int  # rows
    width: int  # columns
    # (3, 3), pixels of the reference plane to pixels of the canvas. If the canvas is not planar, it maps (a, b, 1) to pixels,
    # by a scale and a shift: see `PROJECTIONS`.
    transform: Homography
    projection: str = "planar"  # name of the projection
    camera_matrix: FloatArray | None = None  # (3, 3) of the reference camera; None for a planar canvas
    # (3, 3) rotation from directions of the reference camera to those of which a and b are computed; None for none
    horizon: FloatArray | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def scale(self) -> float:
        """Pixels of the canvas per pixel of the reference frame, in its middle."""
        return float(self.transform[0, 0] / (1 if self.camera_matrix is None else self.camera_matrix[0, 0]))

    @property
    def planar(self) -> bool:
        """Whether a homography maps the reference plane to the canvas."""
        return self.projection == "planar"

    @property
    def plane_to_rays(self) -> Homography:
        """(3, 3): homogeneous pixels of the reference plane to the rays that `pixels` maps and `rays` returns.

        For a planar canvas, rays are homogeneous pixels of the canvas.
        """
        if self.planar:
            return self.transform
        assert self.camera_matrix is not None
        ahead = np.linalg.inv(self.camera_matrix)
        return np.asarray(ahead if self.horizon is None else self.horizon @ ahead, np.float64)

    @property
    def period_px(self) -> float | None:
        """Columns of a full turn; None where a is no angle."""
        return float(2 * np.pi * self.transform[0, 0]) if self._projection.periodic else None

    @property
    def is_full_turn(self) -> bool:
        """Whether the last column is beside the first one."""
        return self.period_px is not None and abs(self.width - self.period_px) < 1e-6 * self.width

    def columns(self) -> tuple[FloatArray, FloatArray]:
        """Return p and s of each column, (W,): the ray of a pixel (x, y) is `(p[x] r[y], q[y], s[x] r[y] + t[y])`."""
        x = np.arange(self.width, dtype=np.float64)
        return self._projection.across(x if self.planar else (x - self.transform[0, 2]) / self.transform[0, 0])[:2]

    def rows(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return q, r and t of each row: (H,)."""
        y = np.arange(self.height, dtype=np.float64)
        return self._projection.down(y if self.planar else (y - self.transform[1, 2]) / self.transform[1, 1])

    def on_plane(self, pixels: FloatArray) -> FloatArray:
        """Return the homogeneous pixels of the reference plane at (..., 2) pixels of the canvas: (..., 3)."""
        transform = np.eye(3) if self.planar else self.transform
        points = (pixels - transform[:2, 2]) / np.diag(transform)[:2]
        return np.asarray(self._projection.rays(points) @ np.linalg.inv(self.plane_to_rays).T)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Return where (..., 3) rays lie on the canvas, or beside it: (..., 2); NaN behind a plane.

        Of the columns of full turns, which are the same place, it is the one on the canvas.
        """
        points = self._projection.points(rays)
        if self.planar:
            return points
        places = np.asarray(points * np.diag(self.transform)[:2] + self.transform[:2, 2])
        if (period := self.period_px) is None:
            return places
        first = min(-0.5, (self.width - 1 - period) / 2)
        places[..., 0] -= period * np.floor((places[..., 0] - first) / period)
        return places

    def part(self, left: int, top: int, height: int, width: int) -> Canvas:
        """Return the canvas of a box of pixels."""
        return replace(self, height=height, width=width, transform=translation(-left, -top) @ self.transform)

    @property
    def _projection(self) -> Projection:
        return PROJECTIONS[self.projection]


def depths(homographies: FloatArray, frame_shape: tuple[int, int], outline: FloatArray | None = None) -> FloatArray:
    """Return how far points of frames lie before the reference plane, relative to its own frame: (N, P), 0 at its horizon.

    The homographies, (N, 3, 3), map pixels of a frame of (height, width) to reference pixels; the outline has (P, 2) points of
    a frame, by default its corners.
    """
    points = corners(frame_shape) if outline is None else outline
    return np.asarray(homographies[:, 2, :2] @ points.T + homographies[:, 2:, 2])


def canvas_of(
    homographies: FloatArray, frame_shape: tuple[int, int], scale: float, outline: FloatArray | None = None
) -> Canvas:
    """Return the smallest planar canvas that holds every frame.

    Args:
        homographies: (N, 3, 3), frame pixels to reference pixels.
        frame_shape: (height, width) of a frame.
        scale: pixels of the canvas per pixel of the reference frame.
        outline: (P, 2) ideal pixels around a frame that a lens distorts; by default its corners.

    Raises:
        ValueError: a frame reaches the horizon of the reference plane, so that no finite canvas holds it.
    """
    frame = corners(frame_shape) if outline is None else outline
    depth = depths(homographies, frame_shape, frame).min(axis=1)
    if depth.min() <= 0:
        index = int(np.argmin(depth))
        raise ValueError(f"homography {index} of {len(homographies)} sends part of its frame behind the reference plane")
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for start in range(0, len(homographies), BLOCK_FRAMES):
        points = transform_points(homographies[start : start + BLOCK_FRAMES], frame).reshape(-1, 2)
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    # Whole reference pixels, so that the canvas of scale 1 samples the reference frame without interpolation.
    low, high = np.floor(low + 1e-6), np.ceil(high - 1e-6)
    width, height = np.ceil((high - low + 1) * scale - 1e-6).astype(int)
    return Canvas(int(height), int(width), rescaling(scale) @ translation(-low[0], -low[1]))


def canvas_of_box(box: Box, scale: float) -> Canvas:
    """Return the canvas of a box in pixels of the reference frame; `scale` is pixels of the canvas per pixel of that frame."""
    x0, y0, x1, y1 = box
    width, height = (int(np.ceil(side * scale - 1e-6)) for side in (x1 - x0, y1 - y0))
    return Canvas(height, width, rescaling(scale) @ translation(-x0, -y0))


_SIDE_POINTS = 16  # points of an outline along each side of a frame
_GAP = 0.02  # a gap of less than this, in radians, in what frames cover of a turn is none

_PRIOR = 1e-3  # how much the mean of what is down counts, beside the directions of rows
# Where the reference camera looks straight up or down, it looks at no a; the horizon is then not levelled.
_STRAIGHT_DOWN = 1e-6


@dataclass(frozen=True, slots=True)
class Covered:
    """What frames cover of all directions, in radians."""

    # the first and the last a; `(-pi, pi)` for a full turn. The first may be below -pi, or the last above pi.
    a: tuple[float, float]
    b: tuple[float, float]  # the first and the last b on the sphere, from -pi / 2 (up) to pi / 2

    @property
    def full_turn(self) -> bool:
        """Whether a has no gap."""
        return self.a[1] - self.a[0] >= 2 * np.pi - 1e-9

    @property
    def field_of_view(self) -> float:
        """The larger of both angles, radians."""
        return max(self.a[1] - self.a[0], self.b[1] - self.b[0])


def outline_of(frame_shape: tuple[int, int], margin_px: float = 0.0) -> FloatArray:
    """Return points along the border of a frame of (height, width), clockwise: (P, 2).

    The border is `margin_px` away from the centres of the outer pixels.
    """
    left, top = -margin_px, -margin_px
    right, bottom = frame_shape[1] - 1 + margin_px, frame_shape[0] - 1 + margin_px
    step = np.arange(_SIDE_POINTS) / _SIDE_POINTS
    x = np.concatenate([left + (right - left) * step, np.full(_SIDE_POINTS, right)])
    y = np.concatenate([np.full(_SIDE_POINTS, top), top + (bottom - top) * step])
    around = np.stack([x, y], axis=-1)
    return np.concatenate([around, [left + right, top + bottom] - around])


def covered_by(rotations: FloatArray, camera: Camera, frame_shape: tuple[int, int]) -> Covered:
    """Return what frames of (height, width) cover, of a camera that turns.

    The rotations, (N, 3, 3), map directions of each frame's camera to those of the canvas.
    """
    directions = camera.directions(outline_of(frame_shape))
    ahead = camera.directions(np.array([(frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2]))
    firsts, lasts, low, high = [], [], np.inf, -np.inf
    for start in range(0, len(rotations), BLOCK_FRAMES):
        block = rotations[start : start + BLOCK_FRAMES]
        middle, points = (PROJECTIONS["spherical"].points(each @ np.swapaxes(block, -1, -2)) for each in (ahead, directions))
        middle = middle.reshape(-1, 2)
        beside = np.remainder(points[..., 0] - middle[:, :1] + np.pi, 2 * np.pi) - np.pi
        first, last = middle[:, 0] + beside.min(axis=1), middle[:, 0] + beside.max(axis=1)
        for pole in (-1.0, 1.0):
            inside = _shows(block, camera, frame_shape, np.array([0.0, pole, 0.0]))
            if inside.any():
                first[inside], last[inside] = -np.pi, np.pi
                low, high = (-np.pi / 2, high) if pole < 0 else (low, np.pi / 2)
        firsts.append(first)
        lasts.append(last)
        low, high = min(low, float(points[..., 1].min())), max(high, float(points[..., 1].max()))
    return Covered(_union(np.concatenate(firsts), np.concatenate(lasts)), (low, high))


def canvas_around(covered: Covered, camera: Camera, scale: float, projection: str, horizon: FloatArray | None = None) -> Canvas:
    """Return the smallest canvas of a projection, not of a plane, that holds what frames cover.

    At scale 1, a pixel at b = 0 is as large as one at the centre of the reference frame. The seam of a full turn
    is at a = pi, behind the reference camera.

    Args:
        covered: what the canvas holds.
        camera: of the reference frame.
        scale: pixels of the canvas per pixel of the reference frame.
        projection: its name.
        horizon: (3, 3) of the canvas.
    """
    per_radian = camera.focal_px * scale
    (first, low), (last, high) = PROJECTIONS[projection].bounds(covered.a, covered.b).tolist()
    if covered.full_turn:
        # A multiple of 4, so that the poles are at borders of pixels, too.
        per_radian = 4 * max(1, round(np.pi * per_radian / 2)) / (2 * np.pi)
    left, top = (np.floor(each * per_radian + 1e-6) for each in (first, low))
    right, bottom = (np.ceil(each * per_radian - 1e-6) for each in (last, high))
    transform = translation(-left - 0.5, -top - 0.5) @ np.diag([per_radian, per_radian, 1.0])
    height, width = max(1, int(bottom - top)), max(1, int(right - left))
    return Canvas(height, width, np.asarray(transform), projection, camera.matrix, horizon)


def level_horizon(rotations: FloatArray) -> FloatArray:
    """Return the rotation of the reference camera after which the horizon is level.

    Who turns a camera hardly rolls it, so that the rows of all frames are level: what is down is the direction that is most
    nearly at right angles to them (Brown and Lowe 2007). The reference camera still looks at a = 0. The rotations, (N, 3, 3),
    map directions of each frame's camera to those of the reference camera.
    """
    along, down = rotations[:, :, 0], rotations[:, :, 1].mean(axis=0)
    # Of a camera that hardly turns, what is down on average decides.
    _, axes = np.linalg.eigh(along.T @ along / len(along) - _PRIOR * np.outer(down, down))
    normal = axes[:, 0] * (1 if axes[:, 0] @ down >= 0 else -1)
    forward = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    if np.linalg.norm(forward) < _STRAIGHT_DOWN:
        return np.eye(3)
    forward /= np.linalg.norm(forward)
    return nearest_rotations(np.stack([np.cross(normal, forward), normal, forward]))


def _shows(rotations: FloatArray, camera: Camera, frame_shape: tuple[int, int], direction: FloatArray) -> FloatArray:
    """Return which frames show a direction: (N,) bool."""
    x, y, z = np.moveaxis(direction @ rotations, -1, 0)
    ahead = z > 1e-9
    ideal = np.stack([x, y], axis=-1) / np.where(ahead, z, 1)[:, None] * camera.focal_px + camera.centre_px
    at = camera.distorted(np.where(ahead[:, None], ideal, np.nan))
    with np.errstate(invalid="ignore"):
        return np.asarray(((at >= -0.5) & (at <= [frame_shape[1] - 0.5, frame_shape[0] - 0.5])).all(axis=1))


def _union(first: FloatArray, last: FloatArray) -> tuple[float, float]:
    """Return the first and the last angle of arcs on a circle, beside the largest gap; `(-pi, pi)` if there is none."""
    full = -np.pi, np.pi
    turn = 2 * np.pi
    if (last - first >= turn - _GAP).any():
        return full
    start = np.remainder(first, turn)
    order = np.argsort(start)
    start, reach = start[order], np.maximum.accumulate((start + (last - first))[order])
    # Arcs that reach over the end of the circle cover its beginning.
    reach = np.maximum(reach, reach[-1] - turn)
    gaps = np.append(start[1:], start[0] + turn) - reach
    widest = int(np.argmax(gaps))
    if gaps[widest] < _GAP:
        return full
    begin = float(np.append(start[1:], start[0])[widest])
    length = turn - float(gaps[widest])
    # Of all equal arcs, the one whose middle is nearest to 0.
    begin -= turn * np.round((begin + length / 2) / turn)
    return float(begin), float(begin + length)
