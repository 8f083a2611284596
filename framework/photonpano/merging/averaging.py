"""How much interpolation between pixels lowers the photon noise of a merge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import Camera, Canvas
from photonpano.merging.footprints import Lens, footprints_of
from photonpano.merging.warping import Grid, image_row
from photonpano.values import FloatArray, FluxImage, FrameSpan

_INSTANTS = 512  # largest number of instants at which the places of frames on the canvas are looked at
# Instants as many as which the average of all pixels counts at each pixel.
_EXPECTED = 2.0
_ROUNDING = 1e-4  # px by which a pixel at the border of a frame may lie outside


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
        part = self.canvas.part(left, top, *shape)
        grid = Grid.zeros(part, 1)
        for at in footprints_of(part, self.camera, self.homographies, self.frame_shape):
            size = -(-self.frame_shape[0] // at.shrink), -(-self.frame_shape[1] // at.shrink)
            for seen in grid.parts(at):
                _add_squares(size, np.ascontiguousarray(at.to_image), at.lens, 1 / at.shrink**2, seen)
        squares, count = grid.total, grid.coverages[0]
        n_seen = float(count.sum(dtype=np.float64))
        mean = float(squares.sum(dtype=np.float64)) / n_seen if n_seen else 1.0
        # Where few instants show a pixel, the average is near that of all pixels.
        return np.asarray(np.sqrt((squares + _EXPECTED * mean) / (count + _EXPECTED)), np.float32)


@compiled
def _add_squares(shape: tuple[int, int], matrix: NDArray[np.float64], lens: Lens, share: float, grid: Grid) -> None:
    """Add the sum of the squared weights of bilinear interpolation, and 1, to the pixels of a grid that a frame covers.

    Args:
        shape: (h, w) of the frame.
        matrix: (3, 3), rays of the grid to ideal coordinates of the frame.
        lens: from these to pixels.
        share: factor of the squares.
        grid: its total is that of the squares, its coverage the number of frames.
    """
    height, width = shape
    u, v = np.empty(len(grid.p), np.float32), np.empty(len(grid.p), np.float32)
    low, right, bottom = -_ROUNDING, width - 1 + _ROUNDING, height - 1 + _ROUNDING
    for y in range(len(grid.q)):
        image_row(matrix, lens, grid, y, u, v)
        x = slice(grid.left, grid.left + len(u))
        row, count = grid.total[grid.top + y, x], grid.coverages[0, grid.top + y, x]
        for t in range(len(row)):
            if u[t] >= low and u[t] <= right and v[t] >= low and v[t] <= bottom:
                a, b = u[t] - np.floor(u[t]), v[t] - np.floor(v[t])
                row[t] += np.float32(share * (a * a + (1 - a) * (1 - a)) * (b * b + (1 - b) * (1 - b)))
                count[t] += np.float32(1)
