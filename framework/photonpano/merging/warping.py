"""Add bilinear warps of images to a grid. Compiled.

`add_warped` is for homographies that hardly rotate: it is vectorised along runs of pixels whose neighbours lie at neighbours of
the image. `add_remapped` is for any other warp: onto a cylinder or a sphere, or through a lens. A pixel of the grid goes to a
ray, through the motion and the lens to a pixel of a frame, and is interpolated there, once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.geometry import Canvas
from photonpano.geometry.sampling import Pixels, run_from, sample_run, visible_columns
from photonpano.merging.footprints import Footprint, Lens
from photonpano.values import FloatArray, FluxImage

# Zeros before and after the rows and columns of an image that is remapped, so that it is interpolated at its border as well.
_PADDING = 1, 2


@compiled
def add_warped(image: Pixels, to_image: NDArray[np.float64], total: NDArray[np.float32]) -> None:
    """Add an image to a grid, interpolated bilinearly; the image is 0 outside of its border.

    Args:
        image: (h, w) float32 or uint32.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        total: (H, W) the grid.
    """
    sampled = np.empty(total.shape[1], np.float32)
    for y in range(total.shape[0]):
        row = total[y]
        first, inside, outside, last = _parts(image.shape, to_image, y, total.shape[1])
        for x in range(first, inside):
            row[x] += _at(image, to_image, x, y)
        for x in range(outside, last):
            row[x] += _at(image, to_image, x, y)
        x = inside
        while x < outside:
            run = run_from(to_image, x, y, outside - x, image.shape[0], image.shape[1])
            sample_run(image, run, sampled[x : x + run.size])
            x += run.size
        totals, values = row[inside:outside], sampled[inside:outside]
        for t in range(len(totals)):
            totals[t] += values[t]


@compiled
def add_footprint(
    shape: tuple[int, int], to_image: NDArray[np.float64], value: float, steps: NDArray[np.float32], total: NDArray[np.float32]
) -> None:
    """Add what `add_warped` adds for an image of one value, but compute pixels at its border only.

    Args:
        shape: (h, w) of the image.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        value: value of every pixel.
        steps: (H, W + 1), row-wise differences; add their cumulative sums to `total` with `add_running_sums` in the end.
        total: (H, W) the grid.
    """
    for y in range(total.shape[0]):
        first, inside, outside, last = _parts(shape, to_image, y, total.shape[1])
        steps[y, inside] += value
        steps[y, outside] -= value
        for x in range(first, inside):
            total[y, x] += value * _coverage(shape, to_image, x, y)
        for x in range(outside, last):
            total[y, x] += value * _coverage(shape, to_image, x, y)


@compiled
def add_running_sums(steps: NDArray[np.float32], total: NDArray[np.float32]) -> None:
    """Add the cumulative sums of `steps` along each row; see `add_footprint`."""
    for y in range(total.shape[0]):
        running, row, step = 0.0, total[y], steps[y]
        for x in range(len(row)):
            running += step[x]
            row[x] += np.float32(running)


def average_squares(image: Pixels, side: int) -> NDArray[np.float32]:
    """Average squares of pixels, (h, w) to (ceil(h / side), ceil(w / side)); the image is padded with 0 to whole squares."""
    if side == 1:
        return np.asarray(image, dtype=np.float32)
    averages = np.zeros((-(-image.shape[0] // side), -(-image.shape[1] // side)), np.float32)
    _add_squares(image, side, averages)
    return averages


@compiled
def _add_squares(image: Pixels, side: int, averages: NDArray[np.float32]) -> None:
    share = np.float32(1 / side**2)
    for y in range(image.shape[0]):
        row, into = image[y], averages[y // side]
        whole = len(row) // side
        for t in range(whole):
            for x in range(side):
                into[t] += share * np.float32(row[t * side + x])
        for x in range(whole * side, len(row)):
            into[whole] += share * np.float32(row[x])


class Grid(NamedTuple):
    """Sums on a grid, and the rays of its pixels: see `Canvas`.

    Attributes:
        p: (W,) of the columns.
        s: (W,) of the columns.
        q: (H,) of the rows.
        r: (H,) of the rows.
        total: (H, W) float32 sums of counts.
        coverages: (P, H, W) float32 sums of what was seen.
    """

    p: NDArray[np.float64]
    s: NDArray[np.float64]
    q: NDArray[np.float64]
    r: NDArray[np.float64]
    total: NDArray[np.float32]
    coverages: NDArray[np.float32]

    @classmethod
    def zeros(cls, canvas: Canvas, number: int) -> Grid:
        """Return no sums on a canvas, with some coverages."""
        coverages = np.zeros((number, *canvas.shape), np.float32)
        return cls(*canvas.columns(), *canvas.rows(), np.zeros(canvas.shape, np.float32), coverages)

    def parts(self, footprint: Footprint) -> list[Grid]:
        """Return views of the parts that a frame may touch."""
        down, boxes = slice(footprint.rows.start, footprint.rows.stop), footprint.columns if footprint.rows else ()
        across = [slice(columns.start, columns.stop) for columns in boxes]
        p, s, q, r, total, coverages = self
        return [Grid(p[x], s[x], q[down], r[down], total[down, x], coverages[:, down, x]) for x in across]


def padded(image: NDArray[np.generic]) -> FluxImage:
    """Return an image as `add_remapped` takes it: float32, with zeros around it."""
    before, after = _PADDING
    found = np.zeros((image.shape[0] + before + after, image.shape[1] + before + after), np.float32)
    found[before : before + image.shape[0], before : before + image.shape[1]] = image
    return found


def add_remapped(counts: FluxImage, seen: FluxImage | None, amounts: FloatArray, footprint: Footprint, grid: Grid) -> None:
    """Add an image to a grid, and its share of each pixel to coverages, both interpolated bilinearly.

    Args:
        counts: the image, from `padded`.
        seen: share of each of its pixels, from `padded`; None if it is 1.
        amounts: (P,) factors of the share.
        footprint: of the frame on the grid.
        grid: added to.
    """
    shares = np.zeros((0, 0), np.float32) if seen is None else seen
    for part in grid.parts(footprint):
        _add_remapped(counts, shares, amounts, np.ascontiguousarray(footprint.to_image), footprint.lens, part)


@compiled
def image_row(
    matrix: NDArray[np.float64], lens: Lens, grid: Grid, row: int, u: NDArray[np.float32], v: NDArray[np.float32]
) -> None:
    """Map a row of a grid to pixels of an image.

    Args:
        matrix: (3, 3), rays to homogeneous ideal coordinates.
        lens: from these to pixels.
        grid: W columns.
        row: of the grid.
        u: (W,) output, x; -9 behind the camera and beyond the lens.
        v: (W,) output, y.
    """
    p, s, q, r = grid.p, grid.s, grid.q[row], grid.r[row]
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
def _add_remapped(
    counts: NDArray[np.float32],
    seen: NDArray[np.float32],
    amounts: NDArray[np.float64],
    matrix: NDArray[np.float64],
    lens: Lens,
    grid: Grid,
) -> None:
    total, coverages = grid.total, grid.coverages
    height, width = np.float32(counts.shape[0] - 3), np.float32(counts.shape[1] - 3)
    rows, columns = total.shape
    stride = np.uint64(counts.shape[1])
    one, zero = np.float32(1), np.float32(0)
    pixels, shares = counts.reshape(-1), seen.reshape(-1)
    u, v = np.empty(columns, np.float32), np.empty(columns, np.float32)
    share, place = np.empty(columns, np.float32), np.empty(columns, np.int32)
    for y in range(rows):
        image_row(matrix, lens, grid, y, u, v)
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
        if seen.size:
            for t in range(columns):
                at = np.uint64(np.uint32(place[t]))
                upper = shares[at] + u[t] * (shares[at + np.uint64(1)] - shares[at])
                lower = shares[at + stride] + u[t] * (shares[at + stride + np.uint64(1)] - shares[at + stride])
                share[t] = upper + v[t] * (lower - upper)
        for k in range(len(amounts)):
            amount, coverage = np.float32(amounts[k]), coverages[k, y]
            for t in range(columns):
                coverage[t] += amount * share[t]


@compiled
def _parts(shape: tuple[int, int], to_image: NDArray[np.float64], y: int, columns: int) -> tuple[int, int, int, int]:
    """Divide a row of a grid.

    Returns:
        first, inside, outside, last: the image contributes to pixels from `first` to `last`, half-open, and those from
        `inside` to `outside` have four neighbours in the image.
    """
    height, width = shape
    first, last = visible_columns(to_image, y, -1.0, width, -1.0, height, columns)
    inside, outside = visible_columns(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, columns)
    if inside >= outside:
        return first, last, last, last
    return first, inside, outside, last


@compiled
def _at(image: Pixels, to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate at the border, beyond which the image is 0."""
    height, width = image.shape
    u, v = _mapped(to_image, x, y)
    left, top = int(np.floor(u)), int(np.floor(v))
    total = 0.0
    for j in range(max(top, 0), min(top + 2, height)):
        for i in range(max(left, 0), min(left + 2, width)):
            total += image[j, i] * (1 - abs(u - i)) * (1 - abs(v - j))
    return total


@compiled
def _coverage(shape: tuple[int, int], to_image: NDArray[np.float64], x: int, y: int) -> float:
    """Interpolate an image of ones at its border."""
    height, width = shape
    u, v = _mapped(to_image, x, y)
    along = max(0.0, min(1.0, 1 + min(u, width - 1 - u)))
    across = max(0.0, min(1.0, 1 + min(v, height - 1 - v)))
    return along * across


@compiled
def _mapped(to_image: NDArray[np.float64], x: int, y: int) -> tuple[float, float]:
    depth = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2]
    return (
        (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) / depth,
        (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) / depth,
    )
