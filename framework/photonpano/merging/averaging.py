"""What the frames that show a pixel do to its noise: interpolation lowers it, and errors of motion and light add to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import Camera, Canvas
from photonpano.merging.footprints import Lens, footprints_of, pixel_sizes, rays_of
from photonpano.merging.warping import Grid, image_row
from photonpano.values import BoolArray, FloatArray, FluxImage, FrameSpan

_INSTANTS = 512  # largest number of instants at which the places of frames on the canvas are looked at
# Instants as many as which the average of all pixels counts at each pixel.
_EXPECTED = 2.0
_ROUNDING = 1e-4  # px by which a pixel at the border of a frame may lie outside
# Variance of a place in a frame along one direction, per squared expected error of its corners: half for one of two
# directions, and half again since errors of roll, zoom and perspective are smaller inside of a frame than at its corners.
_INSIDE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Averages:
    """Means over the frames that show each pixel of a part of a canvas, (h, w) float32."""

    std_factor: FluxImage  # standard deviation of a merge in units of that without interpolation, from 0.5 to 1
    # of the place that they show along one direction, in squared pixels of the canvas; it is that of one frame: neighbouring
    # frames err alike
    motion_variance: FluxImage
    light_variance: FluxImage  # of their gain, relative to it


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """The motion that brings pixels of frames between pixels of a canvas, at instants all over the frames that are rendered."""

    homographies: FloatArray  # (N, 3, 3), pixels of each instant's frame to pixels of the reference plane
    frame_shape: tuple[int, int]  # (height, width) of a frame
    canvas: Canvas  # the pixel grid
    camera: Camera | None  # of the frames; None if it is not known
    std_px: FloatArray  # (N,) expected corner error of each instant's frame, in its pixels
    std_light: FloatArray  # (N,) standard deviation of the gain of its light

    @classmethod
    def of(
        cls,
        trajectory: Trajectory,
        span: FrameSpan,
        frame_shape: tuple[int, int],
        canvas: Canvas,
        camera: Camera | None = None,
        std_px: FloatArray | None = None,
        std_light: FloatArray | None = None,
    ) -> Averaging:
        """Look at random instants, one in each of equal parts of a span: regular ones may show a pan at whole pixels only.

        Standard deviations are those of all frames of the capture, (T,), by default 0. Frames whose light is not known, with an
        infinite one, are not shown.
        """
        number = min(len(span), _INSTANTS)
        part = len(span) / number
        instants = span.start + (part * (np.arange(number) + np.random.default_rng(0).random(number))).astype(int)
        errors, light = (np.zeros(number) if each is None else each[instants] for each in (std_px, std_light))
        shown = np.isfinite(light)
        return cls(trajectory.at(instants[shown]), frame_shape, canvas, camera, errors[shown], light[shown])

    def over(self, shape: tuple[int, int], top: int = 0, left: int = 0) -> Averages:
        """Average over the frames that show each pixel of a part of the canvas.

        A pixel that lies between four of a frame gets the weights w of them, with a sum of 1, and so the variance of a pixel
        times `sum w^2`.

        Args:
            shape: (h, w) of the part.
            top: its first row.
            left: its first column.
        """
        part = self.canvas.part(left, top, *shape)
        grid = Grid.zeros(part, 3)
        sizes = pixel_sizes(rays_of(part, self.homographies), part, self.frame_shape)
        variances = np.stack([_INSIDE * (self.std_px * sizes) ** 2, self.std_light**2], axis=1)
        footprints = footprints_of(part, self.camera, self.homographies, self.frame_shape)
        for at, amounts in zip(footprints, variances, strict=True):
            size = -(-self.frame_shape[0] // at.shrink), -(-self.frame_shape[1] // at.shrink)
            for seen in grid.parts(at):
                _add_frame(size, np.ascontiguousarray(at.to_image), at.lens, 1 / at.shrink**2, amounts, seen)
        count, *others = grid.coverages
        squares, motion, light = (_averaged(each, count) for each in (grid.total, *others))
        return Averages(np.sqrt(squares), motion, light)


def _averaged(total: FluxImage, count: FluxImage) -> FluxImage:
    """Divide sums by the number of instants. Where few of them show a pixel, the result is near that of all pixels."""
    known: BoolArray = np.isfinite(total) & (count > 0)
    n_seen = float(count[known].sum(dtype=np.float64))
    mean = float(total[known].sum(dtype=np.float64)) / n_seen if n_seen else float("inf") if (count > 0).any() else 1.0
    return np.asarray((total + _EXPECTED * mean) / (count + _EXPECTED), np.float32)


@compiled
def _add_frame(
    shape: tuple[int, int],
    matrix: NDArray[np.float64],
    lens: Lens,
    share: float,
    variances: NDArray[np.float64],
    grid: Grid,
) -> None:
    """Add what a frame brings to the pixels of a grid that it covers.

    Args:
        shape: (h, w) of the frame.
        matrix: (3, 3), rays of the grid to ideal coordinates of the frame.
        lens: from these to pixels.
        share: factor of the squared weights of bilinear interpolation.
        variances: (2,) of the motion and of the light.
        grid: its total is that of the squared weights, its first coverage the number of frames, the others those of variances.
    """
    height, width = shape
    u, v = np.empty(len(grid.p), np.float32), np.empty(len(grid.p), np.float32)
    low, right, bottom = -_ROUNDING, width - 1 + _ROUNDING, height - 1 + _ROUNDING
    motion, light = np.float32(variances[0]), np.float32(variances[1])
    for y in range(len(grid.q)):
        image_row(matrix, lens, grid, y, u, v)
        x = slice(grid.left, grid.left + len(u))
        row, sums = grid.total[grid.top + y, x], grid.coverages[:, grid.top + y, x]
        for t in range(len(row)):
            if u[t] >= low and u[t] <= right and v[t] >= low and v[t] <= bottom:
                a, b = u[t] - np.floor(u[t]), v[t] - np.floor(v[t])
                row[t] += np.float32(share * (a * a + (1 - a) * (1 - a)) * (b * b + (1 - b) * (1 - b)))
                sums[0, t] += np.float32(1)
                sums[1, t] += motion
                sums[2, t] += light
