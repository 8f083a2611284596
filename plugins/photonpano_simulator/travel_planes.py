"""Rectangles in space, and what a frame sees of them: exact rays, and textures averaged over the area of each pixel.

Convention:
    Points of the world are (x, y, z) in m: x right, y down, z ahead. A pose (3, 4) maps them to points of the camera,
    X_c = R X_w + t, with the same axes; pixels are K X_c, integers are pixel centres. A point of a rectangle is
    corner + a along + b down with a and b from 0 to 1. It is seen from the side on which `along` points to the right and `down`
    down, and from the other side light passes.

A pixel is divided into 4 x 4 parts, and each part belongs to the nearest plane on its ray. The inverse depth of a plane, and
the places on it divided by depth, are linear in x and y: the parts of a row that a plane covers are found as an interval.
Where one plane covers a whole pixel, or some parts of it, its texture is sampled once for them: along the longer axis of the
area of the pixel on the texture at up to 16 places, each from a pyramid of averages (mip levels), linearly interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, InputError
from photonpano.compiling import compiled
from photonpano.geometry import Camera
from photonpano_simulator.camera import pixel_grid

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


_PARTS = 4  # parts of a pixel along each axis, for the edges of planes
_SAMPLES = 16  # samples of a texture along the longer axis of the area of a pixel, at most
_LEVELS = 16  # levels of a texture, at most: each has half the size of the one before
_STRETCH = 0.3  # largest aspect ratio of the area of a sample, less 1
_BLOCK = 16  # pixels of a row that share the level and the steps of their samples
_FINER = 2  # pixels of the image that a lens distorts, along a pixel of the frame
_SMALLEST = 1e-9  # inverse depth of the furthest point that is seen, in 1 / m


class Atlas(NamedTuple):
    """The levels of all textures in one array."""

    texels: NDArray[np.float32]  # all levels of all textures, row by row
    starts: NDArray[np.int64]  # (P, L), where a level begins
    heights: NDArray[np.int64]  # (P, L), its rows; 0 for none
    widths: NDArray[np.int64]  # (P, L), its columns
    counts: NDArray[np.int64]  # (P,), how many levels a texture has


def atlas_of(textures: tuple[NDArray[np.float16], ...], gain: float = 1.0) -> Atlas:
    """Return the levels of textures, each (height, width), multiplied by a gain."""
    shape = len(textures), _LEVELS
    starts, heights, widths = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    counts, pieces, start = np.zeros(shape[0], np.int64), [], 0
    for plane, texture in enumerate(textures):
        level = texture.astype(np.float32) * np.float32(gain)
        for place in range(_LEVELS):
            starts[plane, place], (heights[plane, place], widths[plane, place]) = start, level.shape
            counts[plane] = place + 1
            pieces.append(level.ravel())
            start += level.size
            if level.size == 1:
                break
            # Each level covers the whole plane, so averages are right for odd sizes too.
            smaller = -(-level.shape[1] // 2), -(-level.shape[0] // 2)
            level = np.asarray(cv2.resize(level, smaller, interpolation=cv2.INTER_AREA), np.float32).reshape(smaller[::-1])
    return Atlas(np.concatenate(pieces), starts, heights, widths, counts)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Renders the frames of one camera."""

    planes: Planes
    atlas: Atlas  # their flux
    matrix: FloatArray
    frame_shape: tuple[int, int]

    def flux(self, pose: FloatArray, frame: float) -> NDArray[np.float32]:
        """Return the flux in a frame, (H, W), from a (3, 4) pose at an instant; 0 where no plane is seen."""
        image = np.empty(self.frame_shape, np.float32)
        maps = self.planes.maps(pose, self.matrix, frame)
        rows = self.planes.rows(pose, self.matrix, frame, self.frame_shape[0])
        _render(maps, rows, self.planes.radii, self.atlas, image)
        return image


class LensView:
    """Renders the frames of a camera whose lens distorts: finer pixels without a lens, interpolated, and averaged."""

    def __init__(self, planes: Planes, atlas: Atlas, camera: Camera, frame_shape: tuple[int, int]) -> None:
        height, width = frame_shape
        parts = (pixel_grid((_FINER * height, _FINER * width)) + 0.5) / _FINER - 0.5
        ideal = camera.ideal(parts)
        if np.isnan(ideal).any():
            raise InputError(
                f"distortion folds the image of {height}x{width} px at the focal length of {camera.focal_px:g} px, so that "
                "nothing is imaged at its border; take smaller coefficients"
            )
        low, high = (np.floor(each(ideal, axis=(0, 1))) for each in (np.min, np.max))
        self._x, self._y = np.moveaxis((_FINER * (ideal - low)).astype(np.float32), -1, 0)
        columns, rows = (_FINER * (high - low) + _FINER + 1).astype(int).tolist()
        to_fine = np.array([[_FINER, 0, -_FINER * low[0]], [0, _FINER, -_FINER * low[1]], [0, 0, 1]])
        self._fine, self._size = View(planes, atlas, to_fine @ camera.matrix, (rows, columns)), (width, height)

    def flux(self, pose: FloatArray, frame: float) -> NDArray[np.float32]:
        """Return the flux in a frame, as `View` does."""
        parts = cv2.remap(self._fine.flux(pose, frame), self._x, self._y, cv2.INTER_LINEAR)
        return np.asarray(cv2.resize(parts, self._size, interpolation=cv2.INTER_AREA), np.float32)


def view_of(planes: Planes, atlas: Atlas, camera: Camera, frame_shape: tuple[int, int]) -> View | LensView:
    """Return what renders the frames of a camera; raises an `InputError` if the lens folds their image."""
    if camera.distorts:
        return LensView(planes, atlas, camera, frame_shape)
    return View(planes, atlas, camera.matrix, frame_shape)


@compiled
def _render(maps: FloatArray, rows: NDArray[np.int64], radii: FloatArray, atlas: Atlas, image: NDArray[np.float32]) -> None:
    """Write the flux of a frame into `image`, (H, W)."""
    height, width = image.shape
    ramp = np.arange(width).astype(np.float32)
    owners = np.empty((_PARTS * _PARTS, width), np.int32)
    nearest = np.empty((_PARTS * _PARTS, width), np.float32)
    differs = np.empty(width, np.int32)
    for i in range(height):
        owners[:] = -1
        nearest[:] = 0
        for p in range(len(maps)):
            if rows[p, 0] <= i < rows[p, 1]:
                _cover(i, np.int32(p), maps[p], radii[p], ramp, owners, nearest)
        differs[:] = 0
        first = owners[0]
        for k in range(1, _PARTS * _PARTS):
            other = owners[k]
            for j in range(width):
                differs[j] |= first[j] ^ other[j]
        _shade(i, owners, differs, maps, atlas, image[i])


@compiled
def _cover(  # noqa: PLR0917
    i: int,
    p: np.int32,
    m: FloatArray,
    radii: FloatArray,
    ramp: NDArray[np.float32],
    owners: NDArray[np.int32],
    nearest: NDArray[np.float32],
) -> None:
    """Enter a plane where it is nearer than those before, in all parts of the pixels of row `i`."""
    width = len(ramp)
    for k in range(_PARTS):
        y = i + (k + 0.5) / _PARTS - 0.5
        a, b, w = m[0, 1] * y + m[0, 2], m[1, 1] * y + m[1, 2], m[2, 1] * y + m[2, 2]
        low, high = _clipped(w - _SMALLEST, m[2, 0], -0.5, width - 0.5)
        low, high = _clipped(a, m[0, 0], low, high)
        low, high = _clipped(w - a, m[2, 0] - m[0, 0], low, high)
        low, high = _clipped(b, m[1, 0], low, high)
        low, high = _clipped(w - b, m[2, 0] - m[1, 0], low, high)
        if radii[0] < 1:
            low, high = _inside_ellipse(a, b, w, m, radii, low, high)
        if low > high:
            continue
        for part in range(_PARTS):
            shift = (part + 0.5) / _PARTS - 0.5
            begin, end = max(0, int(np.ceil(low - shift))), min(width, int(np.floor(high - shift)) + 1)
            if begin >= end:
                continue
            start, step = np.float32(w + m[2, 0] * (shift + begin)), np.float32(m[2, 0])
            depths, owned = nearest[k * _PARTS + part, begin:end], owners[k * _PARTS + part, begin:end]
            for j in range(end - begin):
                here = start + step * ramp[j]
                is_nearer = here > depths[j]
                depths[j] = here if is_nearer else depths[j]
                owned[j] = p if is_nearer else owned[j]


@compiled
def _clipped(constant: float, slope: float, low: float, high: float) -> tuple[float, float]:
    """Return the part of an interval in which constant + slope x is at least 0; empty if its end is below its start."""
    if slope > 0:
        return max(low, -constant / slope), high
    if slope < 0:
        return low, min(high, -constant / slope)
    return (low, high) if constant >= 0 else (1.0, 0.0)


@compiled
def _inside_ellipse(  # noqa: PLR0917
    a: float, b: float, w: float, m: FloatArray, radii: FloatArray, low: float, high: float
) -> tuple[float, float]:
    """Return the part of an interval inside the disc: ((a - w/2) / r)^2 + ((b - w/2) / s)^2 <= w^2 with linear a, b, w."""
    across, across_slope = (a - w / 2) / radii[0], (m[0, 0] - m[2, 0] / 2) / radii[0]
    below, below_slope = (b - w / 2) / radii[1], (m[1, 0] - m[2, 0] / 2) / radii[1]
    square = across_slope**2 + below_slope**2 - m[2, 0] ** 2
    half = across * across_slope + below * below_slope - w * m[2, 0]
    rest = across**2 + below**2 - w**2
    discriminant = half * half - square * rest
    if square <= 0 or discriminant < 0:
        return 1.0, 0.0
    root = np.sqrt(discriminant)
    return max(low, (-half - root) / square), min(high, (-half + root) / square)


@compiled
def _shade(  # noqa: PLR0917
    i: int, owners: NDArray[np.int32], differs: NDArray[np.int32], maps: FloatArray, atlas: Atlas, row: NDArray[np.float32]
) -> None:
    """Write the flux of row `i`."""
    width, j, first = len(row), 0, owners[0]
    while j < width:
        p, end = first[j], j + 1
        if differs[j]:
            row[j] = 0
            _mix(owners, maps, j, i, atlas, row[j:end])
        else:
            while end < min(width, j + _BLOCK) and first[end] == p and not differs[end]:
                end += 1
            row[j:end] = 0
            if p >= 0:
                _add(maps[p], p, j, i, 1.0, atlas, row[j:end])
        j = end


@compiled
def _mix(owners: NDArray[np.int32], maps: FloatArray, j: int, i: int, atlas: Atlas, pixel: NDArray[np.float32]) -> None:  # noqa: PLR0917
    """Add the flux of a pixel that several planes share; the entries of `owners` are used up."""
    n_parts = _PARTS * _PARTS
    for k in range(n_parts):
        p = owners[k, j]
        if p < 0:
            continue
        count, x, y = 0, 0.0, 0.0
        for other in range(k, n_parts):
            if owners[other, j] == p:
                owners[other, j] = -1
                count, x, y = count + 1, x + other % _PARTS, y + other // _PARTS
        x, y = j + (x / count + 0.5) / _PARTS - 0.5, i + (y / count + 0.5) / _PARTS - 0.5
        _add(maps[p], p, x, y, count / n_parts, atlas, pixel)


@compiled
def _add(m: FloatArray, p: int, x: float, y: float, weight: float, atlas: Atlas, pixels: NDArray[np.float32]) -> None:  # noqa: PLR0917
    """Add averages of the texture of a plane over the areas of successive pixels of a row, of which the first is at (x, y)."""
    # Their areas are taken as that of the middle one: its sides on the plane, and their lengths in texels of the finest level.
    middle = x + (len(pixels) - 1) / 2
    depth = 1 / (m[2, 0] * middle + m[2, 1] * y + m[2, 2])
    a, b = depth * (m[0, 0] * middle + m[0, 1] * y + m[0, 2]), depth * (m[1, 0] * middle + m[1, 1] * y + m[1, 2])
    right_a, right_b = depth * (m[0, 0] - a * m[2, 0]), depth * (m[1, 0] - b * m[2, 0])
    down_a, down_b = depth * (m[0, 1] - a * m[2, 1]), depth * (m[1, 1] - b * m[2, 1])
    width, height = atlas.widths[p, 0], atlas.heights[p, 0]
    right, down = (
        np.sqrt((width * right_a) ** 2 + (height * right_b) ** 2),
        np.sqrt((width * down_a) ** 2 + (height * down_b) ** 2),
    )
    longer, shorter = max(right, down), min(right, down)
    n = max(1, min(_SAMPLES, int(np.ceil(longer / max(shorter, 1.0) - _STRETCH))))
    step_a, step_b = (right_a / n, right_b / n) if right >= down else (down_a / n, down_b / n)
    exact = np.log2(max(shorter, longer / n, 1.0))
    level = min(int(exact), atlas.counts[p] - 1)
    share = np.float32(exact - level if level < atlas.counts[p] - 1 else 0.0)
    scale = np.float32(weight / n)
    for each in range(2 if share > 0 else 1):
        _sample(m, x, y, n, step_a, step_b, scale * (share if each else 1 - share), atlas, p, level + each, pixels)


@compiled
def _sample(  # noqa: PLR0913, PLR0917
    m: FloatArray,
    x: float,
    y: float,
    n: int,
    step_a: float,
    step_b: float,
    scale: np.float32,
    atlas: Atlas,
    p: int,
    level: int,
    pixels: NDArray[np.float32],
) -> None:
    """Add `scale` times `n` samples of a level of a texture, interpolated linearly, for each of successive pixels."""
    texels, start, height, width = atlas.texels, atlas.starts[p, level], atlas.heights[p, level], atlas.widths[p, level]
    for k in range(len(pixels)):
        depth = 1 / (m[2, 0] * (x + k) + m[2, 1] * y + m[2, 2])
        a, b = m[0, 0] * (x + k) + m[0, 1] * y + m[0, 2], m[1, 0] * (x + k) + m[1, 1] * y + m[1, 2]
        s = width * (depth * a - step_a * (n - 1) / 2) - 0.5
        t = height * (depth * b - step_b * (n - 1) / 2) - 0.5
        total = np.float32(0)
        for _ in range(n):
            at_s, at_t = min(max(s, 0.0), width - 1.0), min(max(t, 0.0), height - 1.0)
            left, top = int(at_s), int(at_t)
            u, v = np.float32(at_s - left), np.float32(at_t - top)
            upper = start + top * width + left
            right, below = min(width - 1 - left, 1), width * min(height - 1 - top, 1)
            over = texels[upper] + u * (texels[upper + right] - texels[upper])
            under = texels[upper + below] + u * (texels[upper + below + right] - texels[upper + below])
            total += over + v * (under - over)
            s, t = s + width * step_a, t + height * step_b
        pixels[k] += scale * total
