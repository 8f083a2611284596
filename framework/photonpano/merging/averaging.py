"""How much interpolation between pixels lowers the photon noise of a merge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.geometry import Camera, Canvas, translation, visible_columns
from photonpano.merging.bent import BentFootprint, BentGrid, Lens, Rays, image_row
from photonpano.merging.footprints import footprints_of
from photonpano.protocols import Trajectory
from photonpano.values import FloatArray, FluxImage, FrameSpan

_INSTANTS = 512  # largest number of instants at which the places of frames on the canvas are looked at
# The average of a pixel counts as much as this many instants, so that a pixel that few instants show is near it.
_EXPECTED = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """The motion that brings pixels of frames between pixels of a canvas, at instants all over the frames that are rendered.

    Attributes:
        homographies: (N, 3, 3), pixels of each instant's frame to pixels of the reference plane.
        frame_shape: (height, width) of a frame.
        canvas: the pixel grid.
        camera: of the frames; None if it is not known.
    """

    homographies: FloatArray
    frame_shape: tuple[int, int]
    canvas: Canvas
    camera: Camera | None = None

    @classmethod
    def of(
        cls,
        trajectory: Trajectory,
        span: FrameSpan,
        frame_shape: tuple[int, int],
        canvas: Canvas,
        camera: Camera | None = None,
    ) -> Averaging:
        """Look at random instants, one in each of equal parts of a span: regular ones may show a pan at whole pixels only."""
        number = min(len(span), _INSTANTS)
        part = len(span) / number
        instants = span.start + (part * (np.arange(number) + np.random.default_rng(0).random(number))).astype(int)
        return cls(trajectory.at(instants), frame_shape, canvas, camera)

    def std_factor(self, shape: tuple[int, int], top: int = 0, left: int = 0) -> FluxImage:
        """Return the standard deviation of a merge in units of that without interpolation: (h, w), from 0.5 to 1.

        A pixel that lies between four of a frame gets the weights w of them, with a sum of 1, and so the variance of a pixel
        times `sum w^2`, on average over the frames that show it.

        Args:
            shape: (h, w) of a part of the canvas.
            top: first row of the part.
            left: first column.
        """
        squares, seen = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        part = self.canvas.part(left, top, *shape)
        grid = BentGrid.of(part, self.camera, self.homographies, self.frame_shape)
        if grid is not None:
            for bent in grid.footprints(self.homographies, self.frame_shape):
                _add_bent_squares(bent, self.frame_shape, grid.rays, squares, seen)
            return _std_factor(squares, seen)
        to_part = translation(-left, -top) @ (self.canvas.transform @ self.homographies)
        for at in footprints_of(to_part, self.frame_shape, shape):
            if at.rows and at.columns:
                height, width = (-(-side // at.shrink) for side in self.frame_shape)
                _add_squares((height, width), at.to_image, 1 / at.shrink**2, at.rows.start, at.rows.stop, squares, seen)
        return _std_factor(squares, seen)


def _std_factor(squares: FluxImage, seen: FluxImage) -> FluxImage:
    """Return the square root of the mean square, (h, w); near the mean of all pixels where few instants show a pixel."""
    total = float(seen.sum(dtype=np.float64))
    mean = float(squares.sum(dtype=np.float64)) / total if total else 1.0
    return np.asarray(np.sqrt((squares + _EXPECTED * mean) / (seen + _EXPECTED)), np.float32)


def _add_bent_squares(
    footprint: BentFootprint, frame_shape: tuple[int, int], rays: Rays, squares: FluxImage, seen: FluxImage
) -> None:
    """Add what `_add_squares` adds, for a frame whose warp is no homography."""
    p, s, q, r = rays
    down = slice(footprint.rows.start, footprint.rows.stop)
    height, width = (-(-side // footprint.shrink) for side in frame_shape)
    for columns in footprint.columns if footprint.rows else ():
        across = slice(columns.start, columns.stop)
        matrix, share = np.ascontiguousarray(footprint.to_image), 1 / footprint.shrink**2
        parts = squares[down, across], seen[down, across]
        _add_squares_of_rows((height, width), matrix, footprint.lens, (p[across], s[across], q[down], r[down]), share, *parts)


@compiled
def _add_squares_of_rows(
    shape: tuple[int, int],
    matrix: NDArray[np.float64],
    lens: Lens,
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    share: float,
    squares: NDArray[np.float32],
    seen: NDArray[np.float32],
) -> None:
    height, width = shape
    p, s, q, r = rays
    u, v = np.empty(len(p), np.float32), np.empty(len(p), np.float32)
    for y in range(squares.shape[0]):
        image_row(matrix, lens, p, s, q[y], r[y], u, v)
        row, count = squares[y], seen[y]
        for t in range(len(row)):
            if u[t] >= 0 and u[t] <= width - 1 and v[t] >= 0 and v[t] <= height - 1:
                a, b = u[t] - np.floor(u[t]), v[t] - np.floor(v[t])
                row[t] += np.float32(share * (a * a + (1 - a) * (1 - a)) * (b * b + (1 - b) * (1 - b)))
                count[t] += np.float32(1)


@compiled
def _add_squares(
    shape: tuple[int, int],
    to_image: NDArray[np.float64],
    share: float,
    first_row: int,
    last_row: int,
    squares: NDArray[np.float32],
    seen: NDArray[np.float32],
) -> None:
    """Add, to the pixels of a grid that a frame covers, the sum of the squared weights of bilinear interpolation, and 1.

    Args:
        shape: (h, w) of the frame.
        to_image: (3, 3), pixels of the grid to pixels of the frame.
        share: factor of the squares.
        first_row: of the grid, that the frame may cover.
        last_row: after the last one.
        squares: (H, W) the grid.
        seen: (H, W) the grid.
    """
    height, width = shape
    for y in range(first_row, last_row):
        first, last = visible_columns(to_image, y, 0.0, width - 1.0, 0.0, height - 1.0, squares.shape[1])
        row, count = squares[y, first:last], seen[y, first:last]
        for t in range(len(row)):
            x = first + t
            per_depth = 1 / (to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2])
            u = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) * per_depth
            v = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) * per_depth
            a, b = u - np.floor(u), v - np.floor(v)
            row[t] += np.float32(share * (a * a + (1 - a) * (1 - a)) * (b * b + (1 - b) * (1 - b)))
            count[t] += np.float32(1)
