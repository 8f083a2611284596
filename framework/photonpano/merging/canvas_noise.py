"""The noise of a merged panorama: its standard deviation and its saturated pixels, with the corrections of the sensor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import Camera, Canvas, rescaling
from photonpano.merging.averaging import Averaging
from photonpano.merging.footprints import footprints_of
from photonpano.merging.warping import Grid, Texture, add_warped, average_squares
from photonpano.photometry import Factor, FluxRange, flux_std, measurable_range, saturated
from photonpano.values import BoolArray, FloatArray, FluxImage, FrameSpan, Response

_INSTANTS = 64  # largest number of instants at which the corrections of the sensor are warped onto the canvas
_LARGEST_PX = 1024  # longer side of the maps of corrections on a canvas; those of a larger canvas are coarser than its pixels
_BLOCK = 2**18  # values of a tile that are looked at at once
_EVEN = 1e-4  # corrections that differ by less than this are one number
_RGB = 3  # colours of a panorama; clear pixels, which come last, are none


@dataclass(frozen=True, slots=True, eq=False)
class CanvasNoise:
    """Noise model of a canvas: all that its noise depends on beside flux and weight.

    A correction multiplies the counts of a pixel by `slope` and adds `offset` for each frame: see `flux_std`.
    """

    response: Response
    slope: Factor = 1.0  # one number, or a map of the canvas, coarser by `reduction`: (h, w), or (h, w, 3) in colour
    offset: Factor = 0.0  # as `slope`
    share: Factor = 1.0  # weight of a frame, on average, as `slope`: what the weight of the canvas is divided by to get frames
    reduction: float = 1.0  # pixels of the canvas per pixel of the maps, along each side
    averaging: Averaging | None = None  # how far interpolation lowers the noise; None without motion

    @classmethod
    def of(cls, source: Source, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> CanvasNoise:
        """Average the noise model of a capture over the frames of a span that see each place of a canvas."""
        capture = capture_of(source)
        averaging = Averaging.of(trajectory, span, capture.info.frame_shape, canvas, capture.camera)
        if capture.colour is None:
            return replace(cls._corrected(capture, trajectory, span, canvas), averaging=averaging)
        # The grey source equalises the colours, which are rendered without it.
        colours = [cls._corrected(each, trajectory, span, canvas) for each in list(capture.colours().values())[:_RGB]]
        slope, offset, share = (_stacked([getattr(each, name) for each in colours]) for name in ("slope", "offset", "share"))
        return cls(capture.response, slope, offset, share, max(each.reduction for each in colours), averaging)

    @classmethod
    def _corrected(cls, capture: Capture, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> CanvasNoise:
        """Average the corrections of a capture over the frames that see each place of a canvas."""
        if not capture.corrects_sums:
            return cls(capture.response)
        none = np.zeros(capture.info.frame_shape, np.uint32)
        offset = np.asarray(capture.corrected(none, 1), np.float32)
        slope = np.asarray(capture.corrected(none + 1, 1) - offset, np.float32)
        factors, valid = (slope, offset, capture.weights()), capture.valid
        means = [float(each[valid].mean()) for each in factors]
        if max(np.ptp(each[valid]) for each in factors) < _EVEN:
            return cls(capture.response, means[0], means[1], means[2])
        reduction = max(1.0, max(canvas.shape) / _LARGEST_PX)
        height, width = (int(np.ceil(side / reduction)) for side in canvas.shape)
        instants = np.unique(np.linspace(span.start, span.stop - 1, min(len(span), _INSTANTS)).round())
        coarse = replace(canvas, height=height, width=width, transform=rescaling(1 / reduction) @ canvas.transform)
        sums, known = laid(coarse, capture.camera, trajectory.at(instants), factors, valid)
        slope, offset, share = (
            np.asarray(np.where(known > 0, total / np.maximum(known, np.float32(1e-6)), mean), np.float32)
            for total, mean in zip(sums, means, strict=True)
        )
        return cls(capture.response, slope, offset, share, reduction)

    def std(self, flux: FluxImage, weight: FluxImage, top: int = 0, left: int = 0) -> FluxImage:
        """Return the standard deviation of the flux, (h, w) or (h, w, 3), of a part of the canvas from `top`, `left` on."""
        slope, offset, share = (self._part(each, flux, top, left) for each in (self.slope, self.offset, self.share))
        std = flux_std(flux, np.asarray(weight / share, np.float32), self.response, slope, offset)
        if self.averaging is None:
            return std
        factor = self.averaging.std_factor((flux.shape[0], flux.shape[1]), top, left)
        return np.asarray(std * (factor if flux.ndim == 2 else factor[..., None]), np.float32)

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
        part = factor[np.ix_(rows, columns)]
        return part if part.ndim == flux.ndim else part[..., None]


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


def _stacked(factors: list[Factor]) -> Factor:
    """Return one number if the factors of all colours are the same, otherwise a map in three colours."""
    numbers = [each for each in factors if not isinstance(each, np.ndarray)]
    if len(numbers) == len(factors) and np.ptp(numbers) < _EVEN:
        return numbers[0]
    shape = max(np.shape(each) for each in factors) or (1, 1)
    return np.stack([np.broadcast_to(np.asarray(each, np.float32), shape) for each in factors], axis=-1)


@dataclass(slots=True)
class DynamicRange:
    """The range of flux in a panorama, gathered tile by tile."""

    noise: CanvasNoise  # of its canvas
    low: float = float("inf")  # the lowest flux that exceeds its standard deviation; infinite before there is one
    high: float = 0.0  # the highest
    n_saturated: int = 0  # number of values of pixels that were lit in every frame
    n_seen: int = 0  # number of values of pixels that were seen
    frames: float = 0.0  # frames that saw each value, added up

    def add(self, flux: FluxImage, weight: FluxImage, top: int, left: int) -> None:
        """Add a tile, row by row so that it takes little memory."""
        step = max(1, _BLOCK // max(1, flux[0].size)) if len(flux) else 1
        for row in range(0, len(flux), step):
            part, frames = flux[row : row + step], weight[row : row + step]
            std = self.noise.std(part, frames, top + row, left)
            with np.errstate(invalid="ignore"):
                measured = part[part >= std]
            if measured.size:
                self.low, self.high = min(self.low, float(measured.min())), max(self.high, float(measured.max()))
            self.n_saturated += int(np.count_nonzero(self.noise.saturated(part, frames)))
            self.n_seen += int(np.count_nonzero(frames > 0))
            self.frames += float(frames.sum(dtype=np.float64))

    @property
    def decibels(self) -> float | None:
        """Ratio of the highest and the lowest flux that exceed their standard deviation; None if none does."""
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
