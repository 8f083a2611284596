"""Warps that are no homographies: onto a cylinder or a sphere, or through a lens. Compiled.

A pixel of the grid goes to a ray, through the motion and the lens to a pixel of a frame, and is interpolated there, once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.geometry import Camera, Canvas, corners, outline_of, rescaling
from photonpano.merging.warping import average_squares
from photonpano.values import FloatArray, FluxImage, Homography

_NEAR_POLE = np.radians(75)  # a frame that comes this near to a pole may touch any column
_WIDEST = 100.0  # largest radius, in focal lengths, that a lens images
# Zeros before and after the rows and columns of an image that is warped, so that it is interpolated at its border as well.
_PADDING = 1, 2

# p and s of the columns of a grid, q and r of its rows: see `Canvas`.
Rays: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


class Lens(NamedTuple):
    """From homogeneous ideal coordinates to pixels of an image: OpenCV's distortion, then a scale and a shift.

    Ideal points whose squared radius exceeds `limit` are not imaged. Where it is infinite, coordinates are pixels already, and
    the rest is ignored.
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


@dataclass(frozen=True, slots=True, eq=False)
class BentFootprint:
    """Where a frame lies on a grid, and how it is warped there.

    Attributes:
        shrink: squares of this many pixels a side are averaged before the warp.
        to_image: (3, 3), rays of the grid to homogeneous ideal coordinates.
        lens: from these to pixels of the averaged frame.
        rows: rows of the grid that the frame may touch.
        columns: columns that it may touch; two ranges where it crosses the seam of a full turn, none where it lies outside.
    """

    shrink: int
    to_image: Homography
    lens: Lens
    rows: range
    columns: tuple[range, ...]


@dataclass(frozen=True, slots=True, eq=False)
class BentGrid:
    """A grid onto which frames are warped.

    Attributes:
        canvas: the grid.
        camera: of the frames; None without a lens.
    """

    canvas: Canvas
    camera: Camera | None

    @classmethod
    def of(
        cls, canvas: Canvas, camera: Camera | None, homographies: FloatArray, frame_shape: tuple[int, int]
    ) -> BentGrid | None:
        """Return the grid; None if homographies map all frames to it.

        They do not if the canvas is no plane, or the lens distorts, or a frame reaches behind the plane.
        """
        distorts = camera is not None and camera.distorts
        bent = distorts or not canvas.planar
        if not bent:
            to_rays, frame = _to_rays(canvas, homographies), corners(frame_shape)
            bent = bool((to_rays[:, 2:, :2] @ frame.T + to_rays[:, 2:, 2:] <= 0).any())
        return cls(canvas, camera if distorts else None) if bent else None

    @property
    def rays(self) -> Rays:
        """The rays of the grid."""
        return (*self.canvas.columns(), *self.canvas.rows())

    def footprints(self, homographies: FloatArray, frame_shape: tuple[int, int]) -> list[BentFootprint]:
        """Return the footprint of each frame.

        Args:
            homographies: (N, 3, 3), ideal pixels of each frame to pixels of the reference plane.
            frame_shape: (height, width) of a frame.
        """
        to_rays = _to_rays(self.canvas, homographies)
        shrink = self._shrink_factors(to_rays, frame_shape)
        rows, columns = self._touched(to_rays, frame_shape, max(shrink, default=1))
        lenses = {each: self._lens(each, frame_shape) for each in set(shrink)}
        return [
            BentFootprint(each, self._to_ideal(each) @ from_rays, lenses[each], down, across)
            for each, from_rays, down, across in zip(shrink, np.linalg.inv(to_rays), rows, columns, strict=True)
        ]

    def _to_ideal(self, shrink: int) -> Homography:
        """Return the map from pixels of the reference plane to what the lens takes."""
        return rescaling(1 / shrink) if self.camera is None else np.asarray(np.linalg.inv(self.camera.matrix), np.float64)

    def _shrink_factors(self, to_rays: FloatArray, frame_shape: tuple[int, int]) -> list[int]:
        """Return how many pixels in a row fall on one grid pixel: interpolation alone would skip photons."""
        middle = np.array([(frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2])
        around = np.concatenate([middle + np.array([[0, 0], [1, 0], [0, 1]]), np.ones((3, 1))], axis=1)
        rays = around @ np.swapaxes(to_rays, -1, -2)
        if self.canvas.planar:
            points = rays[..., :2] / rays[..., 2:]
            step = np.linalg.norm(points[:, 1:] - points[:, :1], axis=-1).max(axis=-1)
        else:
            unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
            step = np.linalg.norm(unit[:, 1:] - unit[:, :1], axis=-1).max(axis=-1) * self.canvas.transform[0, 0]
        return [max(1, int(factor)) for factor in 1 / step + 1e-6]

    def _lens(self, shrink: int, frame_shape: tuple[int, int]) -> Lens:
        if self.camera is None:
            return Lens(0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, np.inf)
        matrix = rescaling(1 / shrink) @ self.camera.matrix
        ideal = self.camera.ideal(outline_of(frame_shape, 2.0 * shrink))
        radius = np.linalg.norm((ideal - self.camera.centre_px) / self.camera.focal_px, axis=-1)
        limit = float(np.nanmax(radius)) if np.isfinite(radius).all() else _WIDEST
        k1, k2, p1, p2 = self.camera.distortion.tolist()
        return Lens(k1, k2, p1, p2, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], min(limit**2, _fold(k1, k2)))

    def _touched(
        self, to_rays: FloatArray, frame_shape: tuple[int, int], margin: int
    ) -> tuple[list[range], list[tuple[range, ...]]]:
        """Return the rows and the columns of the grid that each frame may touch."""
        height, width = self.canvas.shape
        outline = outline_of(frame_shape, float(margin))
        if self.camera is not None:
            outline = self.camera.ideal(outline)
        ends = np.concatenate([outline, np.ones((len(outline), 1))], axis=1)
        rays = ends @ np.swapaxes(to_rays, -1, -2)
        places = self.canvas.pixels(rays)
        everywhere = ~np.isfinite(places).all(axis=(1, 2))
        places = np.where(np.isfinite(places), places, 0)
        low, high = places[..., 1].min(axis=1), places[..., 1].max(axis=1)
        period = self.canvas.period_px
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
        columns = [
            _turned(first - 1, last + 2, width, period) for first, last in zip(left.tolist(), right.tolist(), strict=True)
        ]
        return rows, columns


def _to_rays(canvas: Canvas, homographies: FloatArray) -> FloatArray:
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


def padded(image: NDArray[np.generic]) -> FluxImage:
    """Return an image as `add_bent` takes it: float32, with zeros around it."""
    before, after = _PADDING
    found = np.zeros((image.shape[0] + before + after, image.shape[1] + before + after), np.float32)
    found[before : before + image.shape[0], before : before + image.shape[1]] = image
    return found


def add_bent(
    counts: FluxImage,
    seen: FluxImage | None,
    amounts: FloatArray,
    footprint: BentFootprint,
    rays: Rays,
    total: FluxImage,
    coverages: FluxImage,
) -> None:
    """Add an image to a grid, and its share of each pixel to coverages, both interpolated bilinearly.

    Args:
        counts: the image, from `padded`.
        seen: share of each of its pixels, from `padded`; None if it is 1.
        amounts: (P,) factors of the share.
        footprint: of the frame on the grid.
        rays: p and s of the columns of the grid, q and r of its rows.
        total: (H, W).
        coverages: (P, H, W).
    """
    p, s, q, r = rays
    down = slice(footprint.rows.start, footprint.rows.stop)
    matrix = np.ascontiguousarray(footprint.to_image)
    for columns in footprint.columns:
        across = slice(columns.start, columns.stop)
        _add(
            counts,
            counts if seen is None else seen,
            seen is not None,
            amounts,
            matrix,
            footprint.lens,
            (p[across], s[across], q[down], r[down]),
            total[down, across],
            coverages[:, down, across],
        )


def laid(
    canvas: Canvas,
    camera: Camera | None,
    homographies: FloatArray,
    images: Sequence[FluxImage],
    valid: FluxImage,
) -> tuple[FluxImage, FluxImage]:
    """Lay images that move with a camera on a canvas, and add them up.

    Args:
        canvas: the grid.
        camera: of the frames; None if it is not known.
        homographies: (N, 3, 3), (ideal) pixels of the frame to pixels of the reference plane at N instants.
        images: K images of a frame, (h, w) each.
        valid: (h, w), 1 where they are known, otherwise 0.

    Returns:
        The sums of the images, (K, H, W), and of what is known, (H, W).
    """
    sums, share = np.zeros((len(images), *canvas.shape), np.float32), np.zeros((1, *canvas.shape), np.float32)
    grid, once, never = BentGrid(canvas, camera if camera is not None and camera.distorts else None), np.ones(1), np.zeros(1)
    for at in grid.footprints(homographies, (valid.shape[0], valid.shape[1])):
        known = padded(average_squares(valid, at.shrink))
        for number, (image, total) in enumerate(zip(images, sums, strict=True)):
            counts = padded(average_squares(np.asarray(image * valid, np.float32), at.shrink))
            add_bent(counts, known, never if number else once, at, grid.rays, total, share)
    return sums, share[0]


@compiled
def image_row(
    matrix: NDArray[np.float64],
    lens: Lens,
    p: NDArray[np.float64],
    s: NDArray[np.float64],
    q: float,
    r: float,
    u: NDArray[np.float32],
    v: NDArray[np.float32],
) -> None:
    """Map a row of a grid to pixels of an image.

    Args:
        matrix: (3, 3), rays to homogeneous ideal coordinates.
        lens: from these to pixels.
        p: (W,) of the columns.
        s: (W,) of the columns.
        q: of the row.
        r: of the row.
        u: (W,) output, x; -9 behind the camera and beyond the lens.
        v: (W,) output, y.
    """
    m00, m01, m02 = matrix[0, 0] * r, matrix[0, 1] * q, matrix[0, 2] * r
    m10, m11, m12 = matrix[1, 0] * r, matrix[1, 1] * q, matrix[1, 2] * r
    m20, m21, m22 = matrix[2, 0] * r, matrix[2, 1] * q, matrix[2, 2] * r
    k1, k2, p1, p2, limit = lens.k1, lens.k2, lens.p1, lens.p2, lens.limit
    focal_x, focal_y, x0, y0 = lens.focal_x, lens.focal_y, lens.x, lens.y
    if limit == np.inf:
        for t in range(len(u)):
            depth = m20 * p[t] + m21 + m22 * s[t]
            nearer = 1 / depth
            x, y = (m00 * p[t] + m01 + m02 * s[t]) * nearer, (m10 * p[t] + m11 + m12 * s[t]) * nearer
            u[t] = np.float32(x if depth > 1e-9 else -9.0)
            v[t] = np.float32(y if depth > 1e-9 else -9.0)
        return
    for t in range(len(u)):
        depth = m20 * p[t] + m21 + m22 * s[t]
        nearer = 1 / depth
        x, y = (m00 * p[t] + m01 + m02 * s[t]) * nearer, (m10 * p[t] + m11 + m12 * s[t]) * nearer
        square = x * x + y * y
        radial = 1 + square * (k1 + k2 * square)
        imaged = (depth > 1e-9) & (square <= limit)
        across = focal_x * (x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)) + x0
        down = focal_y * (y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y) + y0
        u[t] = np.float32(across if imaged else -9.0)
        v[t] = np.float32(down if imaged else -9.0)


@compiled
def _add(
    counts: NDArray[np.float32],
    seen: NDArray[np.float32],
    weighted: bool,
    amounts: NDArray[np.float64],
    matrix: NDArray[np.float64],
    lens: Lens,
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    total: NDArray[np.float32],
    coverages: NDArray[np.float32],
) -> None:
    p, s, q, r = rays
    height, width = np.float32(counts.shape[0] - 3), np.float32(counts.shape[1] - 3)
    rows, columns = total.shape
    stride = np.uint64(counts.shape[1])
    one, zero = np.float32(1), np.float32(0)
    pixels, shares = counts.reshape(-1), seen.reshape(-1)
    u, v = np.empty(columns, np.float32), np.empty(columns, np.float32)
    share, place = np.empty(columns, np.float32), np.empty(columns, np.int32)
    for y in range(rows):
        image_row(matrix, lens, p, s, q[y], r[y], u, v)
        for t in range(columns):
            # From the first zero before the image to the first one after it: beyond, there is nothing to interpolate.
            a, b = min(max(u[t] + one, zero), width + one), min(max(v[t] + one, zero), height + one)
            along, across = min(min(a, width + one - a), one), min(min(b, height + one - b), one)
            share[t] = along * across
            left, top = np.floor(a), np.floor(b)
            u[t], v[t] = a - left, b - top
            place[t] = np.int32(np.float64(top) * counts.shape[1] + left)
        row = total[y]
        for t in range(columns):
            at = np.uint64(np.uint32(place[t]))
            upper = pixels[at] + u[t] * (pixels[at + np.uint64(1)] - pixels[at])
            lower = pixels[at + stride] + u[t] * (pixels[at + stride + np.uint64(1)] - pixels[at + stride])
            row[t] += upper + v[t] * (lower - upper)
        if weighted:
            for t in range(columns):
                at = np.uint64(np.uint32(place[t]))
                upper = shares[at] + u[t] * (shares[at + np.uint64(1)] - shares[at])
                lower = shares[at + stride] + u[t] * (shares[at + stride + np.uint64(1)] - shares[at + stride])
                share[t] = upper + v[t] * (lower - upper)
        for k in range(len(amounts)):
            amount, coverage = np.float32(amounts[k]), coverages[k, y]
            for t in range(columns):
                coverage[t] += amount * share[t]
