"""The uncertainty of a merged panorama: the standard deviation of its flux, by photons, motion and light; saturated pixels.

Interpolation between the frames that show a pixel lowers its noise; errors of their motion and of the light add to it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.compiling import compiled
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import Camera, Canvas, rescaling
from photonpano.merging.warping import (
    Grid,
    Lens,
    Texture,
    add_warped,
    average_squares,
    footprints_of,
    image_row,
    pixel_sizes,
    rays_of,
)
from photonpano.photometry import Factor, FluxRange, flux_std, measurable_range, saturated
from photonpano.values import BoolArray, FloatArray, FluxImage, FrameSpan, Response

_AVERAGED_INSTANTS = 512  # largest number of instants at which the places of frames on the canvas are looked at
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
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
        *,
        canvas: Canvas,
        camera: Camera | None = None,
        std_px: FloatArray | None = None,
        std_light: FloatArray | None = None,
    ) -> Averaging:
        """Look at random instants, one in each of equal parts of a span: regular ones may show a pan at whole pixels only.

        Standard deviations are those of all frames of the capture, (T,), by default 0. Frames whose light is not known, with an
        infinite one, are not shown.
        """
        number = min(len(span), _AVERAGED_INSTANTS)
        part = len(span) / number
        instants = span.start + (part * (np.arange(number) + np.random.default_rng(0).random(number))).astype(int)
        errors, light = (np.zeros(number) if each is None else each[instants] for each in (std_px, std_light))
        shown = np.isfinite(light)
        return cls(
            homographies=trajectory.at(instants[shown]),
            frame_shape=frame_shape,
            canvas=canvas,
            camera=camera,
            std_px=errors[shown],
            std_light=light[shown],
        )

    def over(self, shape: tuple[int, int], top: int = 0, left: int = 0) -> Averages:
        """Average over the frames that show each pixel of a part of the canvas, of (h, w) from row `top` and column `left` on.

        A pixel that lies between four of a frame gets the weights w of them, with a sum of 1, and so the variance of a pixel
        times `sum w^2`.
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
def _add_frame(  # noqa: PLR0917
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


_INSTANTS = 64  # largest number of instants at which the corrections of the sensor are warped onto the canvas
_LARGEST_PX = 1024  # longer side of the maps of corrections on a canvas; those of a larger canvas are coarser than its pixels
_BLOCK = 2**18  # values of a tile that are looked at at once
_EVEN = 1e-4  # corrections that differ by less than this are one number
_LEAST = 1e-30  # squared gradient of flat places
_RGB = 3  # colours of a panorama; clear pixels, which come last, are none


class FluxStd(NamedTuple):
    """Standard deviation of the flux of some rows of a panorama, of the shape of the flux."""

    photons: FluxImage  # by photon noise and dark counts
    whole: FluxImage  # with what the expected errors of motion and light change


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class CanvasNoise:
    """Noise model of a canvas: all that its noise depends on beside flux and weight.

    A correction multiplies the counts of a pixel by `slope` and adds `offset` for each frame: see `flux_std`.
    """

    response: Response
    slope: Factor = 1.0  # one number, or a map of the canvas, coarser by `reduction`: (h, w), or (h, w, 3) in colour
    offset: Factor = 0.0  # as `slope`
    share: Factor = 1.0  # weight of a frame, on average, as `slope`: what the weight of the canvas is divided by to get frames
    reduction: float = 1.0  # pixels of the canvas per pixel of the maps, along each side
    averaging: Averaging | None = None  # what the frames that show a pixel do to its noise; None without motion

    @classmethod
    def of(
        cls, source: Source, trajectory: Trajectory, span: FrameSpan, canvas: Canvas, std_px: FloatArray | None = None
    ) -> CanvasNoise:
        """Average the noise model of a capture over the frames of a span that see each place of a canvas.

        `std_px` (T,) are the expected corner errors of all frames; without them, their motion counts as known.
        """
        capture = capture_of(source)
        std_light = None if capture.light is None else capture.light.std
        averaging = Averaging.of(
            trajectory,
            span,
            capture.info.frame_shape,
            canvas=canvas,
            camera=capture.camera,
            std_px=std_px,
            std_light=std_light,
        )
        if capture.colour is None:
            return replace(cls._corrected(capture, trajectory, span, canvas), averaging=averaging)
        # The grey source equalises the colours, which are rendered without it.
        colours = [cls._corrected(each, trajectory, span, canvas) for each in list(capture.colours().values())[:_RGB]]
        slope, offset, share = (_stacked([getattr(each, name) for each in colours]) for name in ("slope", "offset", "share"))
        return cls(
            response=capture.response,
            slope=slope,
            offset=offset,
            share=share,
            reduction=max(each.reduction for each in colours),
            averaging=averaging,
        )

    @classmethod
    def _corrected(cls, capture: Capture, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> CanvasNoise:
        """Average the corrections of a capture over the frames that see each place of a canvas."""
        if not capture.corrects_sums:
            return cls(response=capture.response)
        none = np.zeros(capture.info.frame_shape, np.uint32)
        offset = np.asarray(capture.corrected(none, 1), np.float32)
        slope = np.asarray(capture.corrected(none + 1, 1) - offset, np.float32)
        factors, valid = (slope, offset, capture.weights()), capture.valid
        means = [float(each[valid].mean()) for each in factors]
        if max(np.ptp(each[valid]) for each in factors) < _EVEN:
            return cls(response=capture.response, slope=means[0], offset=means[1], share=means[2])
        reduction = max(1.0, max(canvas.shape) / _LARGEST_PX)
        height, width = (int(np.ceil(side / reduction)) for side in canvas.shape)
        instants = np.unique(np.linspace(span.start, span.stop - 1, min(len(span), _INSTANTS)).round())
        coarse = replace(canvas, height=height, width=width, transform=rescaling(1 / reduction) @ canvas.transform)
        sums, known = laid(coarse, capture.camera, trajectory.at(instants), factors, valid)
        slope, offset, share = (
            np.asarray(np.where(known > 0, total / np.maximum(known, np.float32(1e-6)), mean), np.float32)
            for total, mean in zip(sums, means, strict=True)
        )
        return cls(response=capture.response, slope=slope, offset=offset, share=share, reduction=reduction)

    def std(self, flux: FluxImage, weight: FluxImage, top: int = 0, left: int = 0) -> FluxImage:
        """Return the standard deviation by photons, (h, w) or (h, w, 3), of a part of the canvas from `top`, `left` on."""
        return self._of_photons(flux, weight, top, left, self._averages(flux, top, left))

    def of_tile(self, flux: FluxImage, weight: FluxImage, top: int, left: int) -> Iterator[tuple[slice, FluxStd]]:
        """Return the standard deviations of a part of the canvas, some rows after the other so that it takes little memory.

        A place that is off by e changes the flux by e times its gradient, which is measured and has noise itself. The flux of a
        saturated pixel is a lower bound, and its error is not known.
        """
        step = max(1, _BLOCK // max(1, flux[0].size)) if len(flux) else 1
        for row in range(0, len(flux), step):
            rows, first = slice(row, min(row + step, len(flux))), max(row - 1, 0)
            part = flux[rows]
            averages = self._averages(part, top + row, left)
            photons = self._of_photons(part, weight[rows], top + row, left, averages)
            variance = photons**2
            if averages is not None:
                squares = squared_gradient(flux[first : rows.stop + 1])[row - first :][: len(part)]
                motion, light = (_as_colours(each, part) for each in (averages.motion_variance, averages.light_variance))
                # An unknown motion moves even places that look flat.
                variance = variance + motion * np.maximum(squares - variance, np.float32(_LEAST)) + light * part**2
            variance[self.saturated(part, weight[rows])] = np.inf
            yield rows, FluxStd(photons, np.asarray(np.sqrt(variance), np.float32))

    def _averages(self, flux: FluxImage, top: int, left: int) -> Averages | None:
        return None if self.averaging is None else self.averaging.over((flux.shape[0], flux.shape[1]), top, left)

    def _of_photons(self, flux: FluxImage, weight: FluxImage, top: int, left: int, averages: Averages | None) -> FluxImage:
        slope, offset, share = (self._part(each, flux, top, left) for each in (self.slope, self.offset, self.share))
        std = flux_std(flux, np.asarray(weight / share, np.float32), self.response, slope, offset)
        return std if averages is None else np.asarray(std * _as_colours(averages.std_factor, flux), np.float32)

    def saturated(self, flux: FluxImage, weight: FluxImage) -> BoolArray:
        """Return the pixels that were lit in every frame."""
        return saturated(flux, weight, self.response)

    def measurable(self, frames: float) -> FluxRange | None:
        """Return the range of flux that a weight in frames measures, with corrections as they are on average."""
        means = float(np.mean(self.slope)), float(np.mean(self.offset))
        return measurable_range(frames / float(np.mean(self.share)), self.response, *means)

    def _part(self, factor: Factor, flux: FluxImage, top: int, left: int) -> Factor:
        if not isinstance(factor, np.ndarray):
            return factor
        rows, columns = (
            np.minimum(((first + np.arange(length)) / self.reduction).astype(int), side - 1)
            for first, length, side in zip((top, left), flux.shape, factor.shape, strict=False)
        )
        return _as_colours(factor[np.ix_(rows, columns)], flux)


def laid(
    canvas: Canvas, camera: Camera | None, homographies: FloatArray, images: Sequence[FluxImage], valid: BoolArray
) -> tuple[FluxImage, FluxImage]:
    """Warp images that move with a camera onto a canvas, and add them up: (K, H, W), and what is known, (H, W).

    `homographies` (N, 3, 3) map (ideal) pixels of the frame to pixels of the reference plane at N instants; the K images are
    (h, w), known where `valid`.
    """
    sums, share = np.zeros((len(images), *canvas.shape), np.float32), np.zeros((1, *canvas.shape), np.float32)
    grid, once, never = Grid.zeros(canvas, 1)._replace(coverages=share), np.ones(1), np.zeros(1)
    for at in footprints_of(canvas, camera, homographies, (valid.shape[0], valid.shape[1])):
        known = Texture.of(average_squares(valid.astype(np.float32), at.shrink))
        for number, (image, total) in enumerate(zip(images, sums, strict=True)):
            counts = Texture.of(average_squares(np.where(valid, image, np.float32(0)), at.shrink))
            add_warped(counts, known, never if number else once, at, grid._replace(total=total))
    return sums, share[0]


def squared_gradient(flux: FluxImage) -> FluxImage:
    """Return the squared gradient of flux, per squared pixel and of its shape, from the known neighbours of each pixel."""
    squares = np.zeros_like(flux)
    for axis in (0, 1):
        padded = np.pad(flux, [(int(each == axis),) * 2 for each in range(flux.ndim)], constant_values=np.nan)
        before, after = np.delete(padded, np.s_[-2:], axis), np.delete(padded, np.s_[:2], axis)
        known = np.isfinite(before).astype(np.float32) + np.isfinite(after)
        rise = np.where(np.isfinite(after), after, flux) - np.where(np.isfinite(before), before, flux)
        squares += (rise / np.maximum(known, 1)) ** 2
    return squares


def _as_colours(image: FluxImage, flux: FluxImage) -> FluxImage:
    """Return an image, (h, w), with an axis of colours if the flux has one."""
    return image if image.ndim == flux.ndim else image[..., None]


def _stacked(factors: list[Factor]) -> Factor:
    """Return one number if the factors of all colours are the same, otherwise a map in three colours."""
    numbers = [each for each in factors if not isinstance(each, np.ndarray)]
    if len(numbers) == len(factors) and np.ptp(numbers) < _EVEN:
        return numbers[0]
    shape = max(np.shape(each) for each in factors) or (1, 1)
    return np.stack([np.broadcast_to(np.asarray(each, np.float32), shape) for each in factors], axis=-1)


@dataclass(slots=True, kw_only=True)
class DynamicRange:
    """The range of flux in a panorama, gathered tile by tile."""

    noise: CanvasNoise  # of its canvas
    low: float = float("inf")  # the lowest flux that noise alone does not reach; infinite before there is one
    high: float = 0.0  # the highest
    n_saturated: int = 0  # number of values of pixels that were lit in every frame
    n_seen: int = 0  # number of values of pixels that were seen
    frames: float = 0.0  # frames that saw each value, added up

    def add(self, flux: FluxImage, weight: FluxImage, std: FluxImage) -> None:
        """Add a part of the panorama, with its standard deviation by photons.

        The lowest of many values would be that of the noisiest pixel: values count that exceed their noise by more than the
        largest of as many draws of noise does, and those of saturated pixels, which are lower bounds.
        """
        by_chance = np.float32(NormalDist().inv_cdf(1 - 0.5 / max(1, flux.size)))
        with np.errstate(invalid="ignore"):
            measured = flux[(flux >= by_chance * std) | self.noise.saturated(flux, weight)]
        if measured.size:
            self.low, self.high = min(self.low, float(measured.min())), max(self.high, float(measured.max()))
        self.n_saturated += int(np.count_nonzero(self.noise.saturated(flux, weight)))
        self.n_seen += int(np.count_nonzero(weight > 0))
        self.frames += float(weight.sum(dtype=np.float64))

    @property
    def decibels(self) -> float | None:
        """Ratio of the highest and the lowest flux that noise alone does not reach; None if there is none."""
        return FluxRange(self.low, self.high).decibels if 0 < self.low <= self.high else None

    @property
    def measurable_decibels(self) -> float | None:
        """Range of flux that the mean number of frames over a pixel measures; None if none is measured.

        It is at least the range that was measured, to which pixels contribute that more frames saw, or with fewer dark counts.
        """
        found = self.noise.measurable(self.frames / self.n_seen) if self.n_seen else None
        return None if found is None else max(found.decibels, self.decibels or 0.0)

    @property
    def saturated_share(self) -> float:
        """Share of the seen values that were lit in every frame."""
        return self.n_saturated / max(1, self.n_seen)
