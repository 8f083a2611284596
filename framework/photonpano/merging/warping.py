"""Add bilinear warps of images to a grid: onto planes, cylinders and spheres, and through a lens. Compiled.

A pixel of the grid goes to a ray, through the motion and the lens to a pixel of a frame, and is interpolated there, once. Each
row takes three loops that the compiler vectorises: places in the image, one word of memory for each place, and interpolation.

A footprint says which pixels of the grid a frame covers, and how it is remapped there, for all chunks at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
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


Image: TypeAlias = NDArray[np.uint8] | NDArray[np.uint32] | NDArray[np.float32]

_LEVELS = 65535  # highest level of a texture
# Pixels of a frame from one exact place to the next: of 8, places between are right to 0.01 px through a strong lens.
NODES_PX = (64, 32, 16, 8)
_FOLDED = 8.0  # places that lie further apart than this, in px for a pixel, are on two sides of a pole or a horizon
_STEPS = np.arange(max(NODES_PX), dtype=np.float32)  # converting integers in the loop would take longer than the rest of it
_BEHIND = 1e-6  # rays with less depth than this are behind the camera


class Texture(NamedTuple):
    """An image made ready for interpolation: a place takes one word of memory instead of four pixels."""

    # (h + 1, w + 1) uint64, or uint32 for an image of bytes. That at (x, y) holds the pixels (x - 1, y - 1), (x, y - 1),
    # (x - 1, y) and (x, y), the first in its lowest bits, as levels of 16 or 8 bits; pixels outside of the image are 0
    texels: NDArray[np.uint32] | NDArray[np.uint64]
    scale: float  # value of a level, a power of two; whole numbers up to 65,535 are exact, others to 1 / 65,535 of their range
    zero: float  # level of 0

    @classmethod
    def of(cls, image: Image) -> Texture:
        """Return the texture of an (h, w) image of finite values."""
        shape = image.shape[0] + 1, image.shape[1] + 1
        if image.dtype == np.uint8:
            small = np.empty(shape, np.uint32)
            _fill_bytes(small, image.view(np.uint8))
            return cls(small, 1.0, 0.0)
        pixels, texels = np.ascontiguousarray(image, np.float32), np.empty(shape, np.uint64)
        low, high = min(0.0, float(pixels.min(initial=0))), float(pixels.max(initial=0))
        scale = 2.0 ** np.ceil(np.log2((high - low) / _LEVELS)) if high > low else 1.0
        zero = np.ceil(-low / scale)
        _fill(texels, pixels, 1 / scale, zero)
        return cls(texels, scale, zero)


@compiled
def _fill(texels: NDArray[np.uint64], image: NDArray[np.float32], levels: float, zero: float) -> None:
    """Fill the texels of an image; `levels` is their number in 1."""
    height, width = image.shape
    row, above, pairs = np.empty(width + 2, np.uint32), np.empty(width + 1, np.uint32), np.empty(width + 1, np.uint32)
    row[:] = np.uint32(zero)
    above[:] = np.uint32(zero) | (np.uint32(zero) << np.uint32(16))
    factor, rounded, most = np.float32(levels), np.float32(zero + 0.5), np.float32(_LEVELS)
    for y in range(height + 1):
        pixels, inner = image[min(y, height - 1)], row[1 : width + 1]
        for x in range(width):
            inner[x] = np.uint32(np.int32(min(pixels[x] * factor + rounded, most)))
        if y == height:
            row[:] = np.uint32(zero)
        left, right, into = row[: width + 1], row[1:], texels[y]
        for x in range(width + 1):
            pairs[x] = left[x] | (right[x] << np.uint32(16))
        for x in range(width + 1):
            into[x] = np.uint64(above[x]) | (np.uint64(pairs[x]) << np.uint64(32))
        above, pairs = pairs, above


@compiled
def _fill_bytes(texels: NDArray[np.uint32], image: NDArray[np.uint8]) -> None:
    """Fill the texels of an image of bytes."""
    height, width = image.shape
    row, above, pairs = np.zeros(width + 2, np.uint32), np.zeros(width + 1, np.uint32), np.zeros(width + 1, np.uint32)
    for y in range(height + 1):
        pixels, inner = image[min(y, height - 1)], row[1 : width + 1]
        for x in range(width):
            inner[x] = np.uint32(pixels[x])
        if y == height:
            row[:] = np.uint32(0)
        left, right, into = row[: width + 1], row[1:], texels[y]
        for x in range(width + 1):
            pairs[x] = left[x] | (right[x] << np.uint32(8))
        for x in range(width + 1):
            into[x] = above[x] | (pairs[x] << np.uint32(16))
        above, pairs = pairs, above


def average_squares(image: Image, side: int) -> Image:
    """Average squares of pixels, (h, w) to (ceil(h / side), ceil(w / side)); the image is padded with 0 to whole squares."""
    if side == 1:
        return image
    averages = np.zeros((-(-image.shape[0] // side), -(-image.shape[1] // side)), np.float32)
    _add_squares(np.ascontiguousarray(image, np.float32), side, averages)
    return averages


@compiled
def _add_squares(image: NDArray[np.float32], side: int, averages: NDArray[np.float32]) -> None:
    share = np.float32(1 / side**2)
    for y in range(image.shape[0]):
        row, into = image[y], averages[y // side]
        whole = len(row) // side
        for t in range(whole):
            for x in range(side):
                into[t] += share * row[t * side + x]
        for x in range(whole * side, len(row)):
            into[whole] += share * row[x]


class Grid(NamedTuple):
    """Sums on a grid, and the rays of the pixels of a box of it: see `Canvas`.

    Sums are those of all of the grid, for loops over slices of them would not be vectorised.
    """

    # (w,) of the columns of the box, relative to `p0`, for float32 is not exact enough for thousands of pixels
    p: NDArray[np.float32]
    s: NDArray[np.float32]  # (w,) of the columns, relative to `s0`
    p0: float  # of the middle column of the grid
    s0: float  # of the middle column
    q: NDArray[np.float64]  # (h,) of the rows of the box
    r: NDArray[np.float64]  # (h,) of the rows
    t: NDArray[np.float64]  # (h,) of the rows
    top: int  # first row of the box
    left: int  # first column
    total: NDArray[np.float32]  # (H, W) float32 sums of counts
    coverages: NDArray[np.float32]  # (P, H, W) float32 sums of what was seen

    @classmethod
    def zeros(cls, canvas: Canvas, number: int) -> Grid:
        """Return no sums on a canvas, which is the box, with some coverages."""
        (p, s), middle = canvas.columns(), canvas.width // 2
        p0, s0 = float(p[middle]), float(s[middle])
        coverages = np.zeros((number, *canvas.shape), np.float32)
        columns = (p - p0).astype(np.float32), (s - s0).astype(np.float32)
        return cls(*columns, p0, s0, *canvas.rows(), 0, 0, np.zeros(canvas.shape, np.float32), coverages)

    def parts(self, footprint: Footprint) -> list[Grid]:
        """Return the same sums, with the boxes that a frame may touch."""
        down, boxes = slice(footprint.rows.start, footprint.rows.stop), footprint.columns if footprint.rows else ()
        rows, across = (
            self._replace(q=self.q[down], r=self.r[down], t=self.t[down], top=down.start),
            [slice(x.start, x.stop) for x in boxes],
        )
        return [rows._replace(p=self.p[x], s=self.s[x], left=x.start) for x in across]


def add_warped(counts: Texture, seen: Texture | None, amounts: FloatArray, footprint: Footprint, grid: Grid) -> None:
    """Add an image to a grid, and its share of each pixel to coverages, both interpolated bilinearly.

    `seen` is the share of each pixel, None if it is 1, and `amounts`, (P,), are factors of it. The footprint is that of the
    frame on the grid.
    """
    for part in grid.parts(footprint):
        to_image = np.ascontiguousarray(footprint.to_image)
        _add_warped(counts, counts if seen is None else seen, seen is None, amounts, to_image, footprint.lens, part)


@compiled
def image_row(  # noqa: PLR0917
    matrix: NDArray[np.float64], lens: Lens, grid: Grid, row: int, u: NDArray[np.float32], v: NDArray[np.float32]
) -> None:
    """Map a row of the box of a grid, of W columns, to pixels of an image, to about 1e-6 of its size.

    `matrix`, (3, 3), maps rays to homogeneous ideal coordinates, and the lens these to pixels. Writes x to `u`, (W,), and y to
    `v`, (W,); x is -9 behind the camera and beyond the lens.
    """
    p, s, q, r, p0, s0 = grid.p, grid.s, grid.q[row], grid.r[row], grid.p0, grid.r[row] * grid.s0 + grid.t[row]
    x0, y0, z0 = np.float32(matrix[0, 0] * r), np.float32(matrix[1, 0] * r), np.float32(matrix[2, 0] * r)
    x1 = np.float32(matrix[0, 0] * r * p0 + matrix[0, 1] * q + matrix[0, 2] * s0)
    y1 = np.float32(matrix[1, 0] * r * p0 + matrix[1, 1] * q + matrix[1, 2] * s0)
    z1 = np.float32(matrix[2, 0] * r * p0 + matrix[2, 1] * q + matrix[2, 2] * s0)
    x2, y2, z2 = np.float32(matrix[0, 2] * r), np.float32(matrix[1, 2] * r), np.float32(matrix[2, 2] * r)
    one, two, behind, nowhere = np.float32(1), np.float32(2), np.float32(_BEHIND), np.float32(-9)
    if lens.limit == np.inf:
        for t in range(len(u)):
            depth = z0 * p[t] + z1 + z2 * s[t]
            nearer = one / depth
            x, y = (x0 * p[t] + x1 + x2 * s[t]) * nearer, (y0 * p[t] + y1 + y2 * s[t]) * nearer
            u[t] = x if depth > behind else nowhere
            v[t] = y if depth > behind else nowhere
        return
    k1, k2, p1, p2 = np.float32(lens.k1), np.float32(lens.k2), np.float32(lens.p1), np.float32(lens.p2)
    focal_x, focal_y, limit = np.float32(lens.focal_x), np.float32(lens.focal_y), np.float32(lens.limit)
    centre_x, centre_y = np.float32(lens.x), np.float32(lens.y)
    for t in range(len(u)):
        depth = z0 * p[t] + z1 + z2 * s[t]
        nearer = one / depth
        x, y = (x0 * p[t] + x1 + x2 * s[t]) * nearer, (y0 * p[t] + y1 + y2 * s[t]) * nearer
        square = x * x + y * y
        radial = one + square * (k1 + k2 * square)
        imaged = (depth > behind) & (square <= limit)
        across = focal_x * (x * radial + two * p1 * x * y + p2 * (square + two * x * x)) + centre_x
        down = focal_y * (y * radial + p1 * (square + two * y * y) + two * p2 * x * y) + centre_y
        u[t] = across if imaged else nowhere
        v[t] = down if imaged else nowhere


@compiled
def _add_warped(  # noqa: PLR0917
    counts: Texture,
    seen: Texture,
    whole: bool,
    amounts: NDArray[np.float64],
    matrix: NDArray[np.float64],
    lens: Lens,
    grid: Grid,
) -> None:
    """Add an image and its share of each pixel, which is that of `seen`, or 1 for a `whole` image."""
    rows, columns = len(grid.q), len(grid.p)
    u, v, share = np.empty(columns, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
    places, texels = np.empty(columns, np.uint32), np.empty(columns, counts.texels.dtype)
    texels_seen = np.empty(columns, seen.texels.dtype)
    for y in range(rows):
        image_row(matrix, lens, grid, y, u, v)
        first, last = _places(u, v, counts.texels.shape, places, share)
        if first >= last:
            continue
        a, b, at, into = u[first:last], v[first:last], places[first:last], texels[: last - first]
        _read(counts, at, into)
        row, x = grid.top + y, slice(grid.left + first, grid.left + last)
        _add_interpolated(counts, into, a, b, grid.total[row, x])
        weight = share[first:last]
        if not whole:
            weight[:] = 0
            _read(seen, at, texels_seen[: last - first])
            _add_interpolated(seen, texels_seen[: last - first], a, b, weight)
        for k in range(len(amounts)):
            amount, coverage = np.float32(amounts[k]), grid.coverages[k, row, x]
            for t in range(len(weight)):
                coverage[t] += amount * weight[t]


@compiled
def sample(  # noqa: PLR0917
    image: Texture,
    nearest: NDArray[np.float32],
    nodes: NDArray[np.float32],
    step: int,
    period: tuple[float, float],
    into: NDArray[np.float32],
) -> None:
    """Sample two images at the pixels of a frame, the first linearly, the second at the nearest pixel: (2, H, W).

    Args:
        image: (h, w) pixels.
        nearest: (h + 2, w + 1), the second image, with a row of zeros on either side and a column of them before.
        nodes: (y, x, 2) places in the images of every `step`th pixel; places between are interpolated linearly. Nothing is
            sampled where they are further apart than `_FOLDED` px a pixel.
        step: one of `NODES_PX`.
        period: first column of a turn, and columns of a full turn, by which places are brought onto the images; infinite ones
            if they are no turn.
        into: output; 0 beside the images.
    """
    height, width = into.shape[1:]
    n_nodes, stride = nodes.shape[1], np.int32(image.texels.shape[1])
    u, v = np.empty(n_nodes * step, np.float32), np.empty(n_nodes * step, np.float32)
    places, share = np.empty(len(u), np.uint32), np.empty(len(u), np.float32)
    words, flat, half = np.empty(width, np.uint64), nearest.reshape(-1), np.float32(0.5)
    first, turn, far, nowhere = np.float32(period[0]), np.float32(period[1]), np.float32(_FOLDED * step), np.float32(-9)
    for y in range(height):
        above, below, part = nodes[y // step], nodes[y // step + 1], np.float32(y % step) / np.float32(step)
        for k in range(n_nodes - 1):
            x0, y0 = above[k, 0] + part * (below[k, 0] - above[k, 0]), above[k, 1] + part * (below[k, 1] - above[k, 1])
            x1 = above[k + 1, 0] + part * (below[k + 1, 0] - above[k + 1, 0])
            y1 = above[k + 1, 1] + part * (below[k + 1, 1] - above[k + 1, 1])
            if abs(x1 - x0) + abs(y1 - y0) + abs(below[k, 0] - above[k, 0]) + abs(below[k, 1] - above[k, 1]) < far:
                dx, dy = (x1 - x0) / np.float32(step), (y1 - y0) / np.float32(step)
            else:  # NaN, too
                x0, y0, dx, dy = nowhere, nowhere, np.float32(0), np.float32(0)
            along, across = u[k * step : (k + 1) * step], v[k * step : (k + 1) * step]
            for t in range(len(along)):
                along[t], across[t] = x0 + _STEPS[t] * dx, y0 + _STEPS[t] * dy
        if turn < np.inf:
            for t in range(width):
                u[t] -= turn * np.floor((u[t] - first) / turn)
        a, b, at = u[:width], v[:width], places[:width]
        _places(a, b, image.texels.shape, at, share)
        _read(image, at, words)
        value, known = into[0, y], into[1, y]
        value[:] = np.float32(0)
        _add_interpolated(image, words, a, b, value)
        for t in range(width):
            at[t] = np.uint32(at[t] + np.uint32(np.int32(a[t] + half) + stride * np.int32(b[t] + half)))
        for t in range(width):
            known[t] = flat[np.uint64(at[t])]


@compiled
def _places(
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    shape: tuple[int, int],
    places: NDArray[np.uint32],
    share: NDArray[np.float32],
) -> tuple[int, int]:
    """Return the half-open range of places in an image.

    Args:
        u: (W,) x in the image; becomes the fraction between two pixels.
        v: (W,) y, likewise.
        shape: of its texels.
        places: (W,) output, numbers of texels.
        share: (W,) output, 1 within the image, falling to 0 over one pixel outside of it.
    """
    height, width, one, zero = np.float32(shape[0]), np.float32(shape[1]), np.float32(1), np.float32(0)
    stride, columns = np.int32(shape[1]), len(u)
    first, last = np.int32(columns), np.int32(0)
    for t in range(columns):
        # From the first zero before the image to the first one after it: beyond, there is nothing to interpolate.
        a, b = u[t] + one, v[t] + one
        along, across = min(min(a, width - a), one), min(min(b, height - b), one)
        within = (along > zero) & (across > zero)
        a, b = a if within else zero, b if within else zero
        left, top = np.int32(a), np.int32(b)
        u[t], v[t] = a - np.float32(left), b - np.float32(top)
        places[t] = np.uint32(np.int32(top * stride + left))
        share[t] = along * across if within else zero
        here = np.int32(t)
        first = min(first, here if within else np.int32(columns))
        last = max(last, np.int32(here + np.int32(1)) if within else np.int32(0))
    return int(first), int(last)


@compiled
def _read(texture: Texture, places: NDArray[np.uint32], into: NDArray[np.uint32] | NDArray[np.uint64]) -> None:
    texels = texture.texels.reshape(-1)
    for t in range(len(into)):
        into[t] = texels[np.uint64(places[t])]


@compiled
def _add_interpolated(
    texture: Texture,
    texels: NDArray[np.uint32] | NDArray[np.uint64],
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    into: NDArray[np.float32],
) -> None:
    """Add texels interpolated at the fractions a along x and b along y."""
    words, low, high, byte = texels.view(np.uint32), np.uint32(0xFFFF), np.uint32(16), np.uint32(0xFF)
    scale, zero = np.float32(texture.scale), np.float32(texture.scale * texture.zero)
    if texels.itemsize == 4:
        for t in range(len(into)):
            word = words[t]
            p, q = np.float32(np.int32(word & byte)), np.float32(np.int32((word >> np.uint32(8)) & byte))
            r, s = np.float32(np.int32((word >> high) & byte)), np.float32(np.int32(word >> np.uint32(24)))
            upper, lower = p + a[t] * (q - p), r + a[t] * (s - r)
            into[t] += upper + b[t] * (lower - upper)
        return
    for t in range(len(into)):
        above, below = words[np.uint64(2) * np.uint64(t)], words[np.uint64(2) * np.uint64(t) + np.uint64(1)]
        p, q = np.float32(np.int32(above & low)), np.float32(np.int32(above >> high))
        r, s = np.float32(np.int32(below & low)), np.float32(np.int32(below >> high))
        upper, lower = p + a[t] * (q - p), r + a[t] * (s - r)
        into[t] += scale * (upper + b[t] * (lower - upper)) - zero
