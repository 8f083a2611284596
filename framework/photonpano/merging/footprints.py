"""Footprints of frames on a grid: which pixels each frame covers, and how it is remapped there, for all chunks at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from photonpano.geometry import Camera, Canvas, corners, inverse, outline_of, rescaling, transform_points
from photonpano.values import FloatArray, Homography

_NEAR_POLE = np.radians(75)  # a frame that comes this near to a pole may touch any column
_WIDEST = 100.0  # largest radius, in focal lengths, that a lens images


class Lens(NamedTuple):
    """From homogeneous ideal coordinates to pixels of an image: OpenCV's distortion, then a scale and a shift.

    Ideal points whose squared radius exceeds `limit` are not imaged. If it is infinite, coordinates are pixels already, and the
    rest is ignored.
    """

    k1: float
    k2: float
    p1: float
    p2: float
    focal_x: float
    focal_y: float
    x: float
    y: float
    limit: float


NO_LENS = Lens(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """Where a frame lies on a grid, and how it is remapped there."""

    shrink: int  # squares of this many pixels a side are averaged before the warp
    to_image: Homography  # (3, 3), rays of the grid to homogeneous ideal coordinates; on a plane, pixels of the grid
    rows: range  # rows of the grid that the frame may touch; empty if it lies outside
    # columns that it may touch; two ranges where it crosses the seam of a full turn, none where it lies outside
    columns: tuple[range, ...]
    lens: Lens = NO_LENS  # from ideal coordinates to pixels of the averaged frame


def by_homographies(canvas: Canvas, camera: Camera | None, homographies: FloatArray, frame_shape: tuple[int, int]) -> bool:
    """Return whether homographies map all frames to a canvas.

    They do not if the canvas is no plane, or the lens distorts, or a frame reaches behind the plane.
    """
    if not canvas.planar or (camera is not None and camera.distorts):
        return False
    to_rays = rays_of(canvas, homographies)
    return not bool((to_rays[:, 2:, :2] @ corners(frame_shape).T + to_rays[:, 2:, 2:] <= 0).any())


def footprints_of(
    canvas: Canvas, camera: Camera | None, homographies: FloatArray, frame_shape: tuple[int, int]
) -> list[Footprint]:
    """Return the footprint of each frame on a canvas; (N, 3, 3) map (ideal) pixels to pixels of the reference plane."""
    if not by_homographies(canvas, camera, homographies, frame_shape):
        return _remapped(canvas, camera if camera is not None and camera.distorts else None, homographies, frame_shape)
    to_grid = canvas.transform @ homographies
    shrink = _shrink_factors(to_grid, canvas, frame_shape)
    to_grid = to_grid @ np.array([rescaling(factor) for factor in shrink]).reshape(-1, 3, 3)
    shrunk = [(-(-frame_shape[0] // factor), -(-frame_shape[1] // factor)) for factor in shrink]
    outlines = np.array([corners(shape) for shape in shrunk]).reshape(-1, 4, 2)
    low, high = _touched(transform_points(to_grid, outlines), canvas.shape)
    to_image = inverse(to_grid)
    return [
        Footprint(factor, back, range(y0, y1), (range(x0, x1),) if x0 < x1 else ())
        for factor, back, (x0, y0), (x1, y1) in zip(shrink, to_image, low.tolist(), high.tolist(), strict=True)
    ]


def _remapped(canvas: Canvas, camera: Camera | None, homographies: FloatArray, frame_shape: tuple[int, int]) -> list[Footprint]:
    """Return the footprints of frames that no homographies map to a canvas; `camera` is None without a lens."""
    to_rays = rays_of(canvas, homographies)
    shrink = _shrink_factors(to_rays, canvas, frame_shape)
    outline = outline_of(frame_shape, float(max(shrink, default=1)))
    rows, columns = _touched_around(canvas, outline if camera is None else camera.ideal(outline), to_rays)
    lenses = {each: NO_LENS if camera is None else _lens_of(camera, frame_shape, each) for each in set(shrink)}
    # From pixels of the reference plane to what the lens takes.
    to_ideal = {each: rescaling(1 / each) if camera is None else np.linalg.inv(camera.matrix) for each in lenses}
    return [
        Footprint(each, np.ascontiguousarray(to_ideal[each] @ from_rays), down, across, lenses[each])
        for each, from_rays, down, across in zip(shrink, np.linalg.inv(to_rays), rows, columns, strict=True)
    ]


def _lens_of(camera: Camera, frame_shape: tuple[int, int], shrink: int) -> Lens:
    matrix = rescaling(1 / shrink) @ camera.matrix
    ideal = camera.ideal(outline_of(frame_shape, 2.0 * shrink))
    radius = np.linalg.norm((ideal - camera.centre_px) / camera.focal_px, axis=-1)
    limit = float(np.nanmax(radius)) if np.isfinite(radius).all() else _WIDEST
    k1, k2, p1, p2 = camera.distortion.tolist()
    return Lens(k1, k2, p1, p2, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], min(limit**2, _fold(k1, k2)))


def _touched_around(canvas: Canvas, outline: FloatArray, to_rays: FloatArray) -> tuple[list[range], list[tuple[range, ...]]]:
    """Return the rows and the columns of the grid that each frame may touch, from (P, 2) ideal pixels around a frame."""
    height, width = canvas.shape
    ends = np.concatenate([outline, np.ones((len(outline), 1))], axis=1)
    rays = ends @ np.swapaxes(to_rays, -1, -2)
    places = canvas.pixels(rays)
    everywhere = ~np.isfinite(places).all(axis=(1, 2))
    places = np.where(np.isfinite(places), places, 0)
    low, high = places[..., 1].min(axis=1), places[..., 1].max(axis=1)
    period = canvas.period_px
    if period is None:
        left, right = places[..., 0].min(axis=1), places[..., 0].max(axis=1)
    else:
        middle = places[:, :1, 0]
        beside = np.remainder(places[..., 0] - middle + period / 2, period) - period / 2
        left, right = middle[:, 0] + beside.min(axis=1), middle[:, 0] + beside.max(axis=1)
        elevation = np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
        up, down = elevation.min(axis=1) < -_NEAR_POLE, elevation.max(axis=1) > _NEAR_POLE
        low, high = np.where(up, 0, low), np.where(down, height, high)
        left, right = np.where(up | down, 0, left), np.where(up | down, period, right)
    low, high = np.where(everywhere, 0, low), np.where(everywhere, height, high)
    left, right = np.where(everywhere, 0, left), np.where(everywhere, width, right)
    rows = [_clipped(first - 1, last + 2, height) for first, last in zip(low.tolist(), high.tolist(), strict=True)]
    columns = [_turned(first - 1, last + 2, width, period) for first, last in zip(left.tolist(), right.tolist(), strict=True)]
    return rows, columns


def rays_of(canvas: Canvas, homographies: FloatArray) -> FloatArray:
    """Return the maps from homogeneous ideal pixels of frames to rays of a canvas, (N, 3, 3), that keep what is ahead ahead."""
    to_rays = canvas.plane_to_rays @ homographies
    return np.asarray(to_rays * np.sign(np.linalg.det(to_rays))[:, None, None])


def _clipped(first: float, last: float, length: int) -> range:
    """Return the pixels between two places."""
    return range(int(min(max(np.floor(first), 0), length)), int(max(min(np.ceil(last), length), 0)))


def _turned(first: float, last: float, width: int, period: float | None) -> tuple[range, ...]:
    """Return the columns of a grid between two places, on all turns of the circle."""
    if period is None:
        parts = [_clipped(first, last, width)]
    elif last - first >= period:
        parts = [range(width)]
    else:
        turns = np.arange(np.floor(-last / period), np.ceil((width - first) / period) + 1) * period
        parts = [_clipped(first + turn, last + turn, width) for turn in turns.tolist()]
    return tuple(part for part in parts if part)


def _fold(k1: float, k2: float) -> float:
    """Return the squared radius at which radial distortion folds the image over; infinite if it never does."""
    roots = np.roots([5 * k2, 3 * k1, 1]) if k2 else np.array([-1 / (3 * k1)] if k1 else [])
    real = [float(root.real) for root in np.atleast_1d(roots) if abs(root.imag) < 1e-12 and root.real > 0]
    return min(real, default=np.inf)


def pixel_sizes(to_rays: FloatArray, canvas: Canvas, frame_shape: tuple[int, int]) -> FloatArray:
    """Return how large the pixel in the middle of each of N frames is on a canvas, in its pixels: (N,)."""
    middle = np.array([(frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2])
    around = np.concatenate([middle + np.array([[0, 0], [1, 0], [0, 1]]), np.ones((3, 1))], axis=1)
    rays = around @ np.swapaxes(to_rays, -1, -2)
    points = rays[..., :2] / rays[..., 2:] if canvas.planar else rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    step = np.linalg.norm(points[:, 1:] - points[:, :1], axis=-1).max(axis=-1)
    return np.asarray(step * (1 if canvas.planar else canvas.transform[0, 0]))


def _shrink_factors(to_rays: FloatArray, canvas: Canvas, frame_shape: tuple[int, int]) -> list[int]:
    """Return how many pixels in a row fall on one grid pixel: interpolation alone would skip photons."""
    return [max(1, int(factor)) for factor in 1 / pixel_sizes(to_rays, canvas, frame_shape) + 1e-6]


def _touched(outline: FloatArray, grid_shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the first (x, y) of the grid that each frame of (N, 4, 2) corners may touch, and the one after the last."""
    size = np.array([grid_shape[1], grid_shape[0]])
    low = np.clip(np.floor(outline.min(axis=1)) - 1, 0, size)
    high = np.clip(np.ceil(outline.max(axis=1)) + 2, low, size)
    return low.astype(int), high.astype(int)
