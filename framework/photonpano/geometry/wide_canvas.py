"""The canvas of a camera that turns: what its frames cover of a cylinder or a sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry.camera import Camera, nearest_rotations
from photonpano.geometry.canvas import PROJECTIONS, Canvas
from photonpano.geometry.homographies import BLOCK_FRAMES, translation
from photonpano.values import FloatArray

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
    """Return points along the border of a frame, clockwise: (P, 2).

    Args:
        frame_shape: (height, width).
        margin_px: distance of the border from the centres of the outer pixels.
    """
    left, top = -margin_px, -margin_px
    right, bottom = frame_shape[1] - 1 + margin_px, frame_shape[0] - 1 + margin_px
    step = np.arange(_SIDE_POINTS) / _SIDE_POINTS
    x = np.concatenate([left + (right - left) * step, np.full(_SIDE_POINTS, right)])
    y = np.concatenate([np.full(_SIDE_POINTS, top), top + (bottom - top) * step])
    around = np.stack([x, y], axis=-1)
    return np.concatenate([around, [left + right, top + bottom] - around])


def covered_by(rotations: FloatArray, camera: Camera, frame_shape: tuple[int, int]) -> Covered:
    """Return what the frames of a camera that turns cover.

    Args:
        rotations: (N, 3, 3), directions of each frame's camera to those of the canvas.
        camera: of all frames.
        frame_shape: (height, width) of a frame.
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
    """Return the smallest canvas of a cylinder or a sphere that holds what frames cover.

    At scale 1, a pixel at b = 0 is as large as one at the centre of the reference frame. The seam of a full turn
    is at a = pi, behind the reference camera.

    Args:
        covered: what the canvas holds.
        camera: of the reference frame.
        scale: pixels of the canvas per pixel of the reference frame.
        projection: "cylindrical" or "spherical".
        horizon: (3, 3) of the canvas.
    """
    down = np.tan if projection == "cylindrical" else np.asarray
    per_radian = camera.focal_px * scale
    (first, last), (low, high) = covered.a, (float(down(each)) for each in covered.b)
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
    nearly at right angles to them (Brown and Lowe 2007). The reference camera still looks at a = 0.

    Args:
        rotations: (N, 3, 3), directions of each frame's camera to those of the reference camera.
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
