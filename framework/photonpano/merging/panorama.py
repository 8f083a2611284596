"""Render the panorama: divide its canvas into tiles that fit into memory, merge all located frames on each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Renderer, Source, Trajectory
from photonpano.execution.context import Context
from photonpano.execution.threads import InOrder
from photonpano.geometry import Canvas, rescaling
from photonpano.merging.accumulate import accumulate
from photonpano.merging.canvas_noise import DynamicRange
from photonpano.merging.canvas_plan import BYTES_PER_PIXEL
from photonpano.merging.chunks import chunks_of
from photonpano.merging.colour import channels_of, in_colours, seen_in
from photonpano.photometry import debiased
from photonpano.values import FluxImage, FrameSpan, Panorama


class MergeRenderer:
    """Warps the photons of all frames to the canvas, and estimates the flux of each pixel once (paper, equation 3)."""

    def __init__(self, in_order: InOrder) -> None:
        """Take what works on several parts at once, such as that of a `StageContext`; the result does not depend on it."""
        self._in_order = in_order

    def render(
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Merge the frames of a span on a canvas: see `Renderer`."""
        capture = capture_of(source)
        cuts = [each.start for each in capture.pieces(span)]
        if capture.background is not None:
            cuts += capture.background.instants.tolist()
        chunks = chunks_of(span, trajectory, source.info.frame_shape, tolerance_px, cuts)
        photons = accumulate(source, chunks, canvas, canvas.shape, advance, self._in_order)
        flux, weight = photons.estimate(source.response)
        return Panorama(debiased(flux, weight, source.response), weight, canvas.transform)


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A part of a canvas."""

    left: int  # first column, on the canvas
    top: int  # first row, on the canvas
    canvas: Canvas  # pixel grid of the tile


def tiles_of(canvas: Canvas, memory: int, bytes_per_pixel: int = BYTES_PER_PIXEL) -> tuple[tuple[Tile, ...], int]:
    """Divide the longer side of a canvas into tiles that are rendered one by one within the memory.

    Also return the factor by which a `Thumbnail` that fits beside a tile is smaller than the canvas. Tiles begin at multiples
    of that factor; it is 1 if the whole canvas fits.
    """
    fits = memory // bytes_per_pixel
    n_pixels = canvas.height * canvas.width
    if n_pixels <= fits:
        return (Tile(0, 0, canvas),), 1
    reduction = int(np.ceil(np.sqrt(4 * n_pixels / fits)))
    longer, shorter = max(canvas.shape), min(canvas.shape)
    length = max(1, fits // (2 * shorter * reduction)) * reduction
    tiles = []
    for start in range(0, longer, length):
        size = min(length, longer - start)
        left, top = (start, 0) if canvas.width == longer else (0, start)
        height, width = (canvas.height, size) if canvas.width == longer else (size, canvas.width)
        tiles.append(Tile(left, top, canvas.part(left, top, height, width)))
    return tuple(tiles), reduction


def render(
    source: Source,
    trajectory: Trajectory,
    span: FrameSpan,
    canvas: Canvas,
    tolerance_px: float,
    context: Context,
    renderer: Renderer | None = None,
) -> Panorama:
    """Render the frames of a span on a canvas that is not divided; by default, all frames are merged.

    Flux and weight of a capture in colour are (H, W, C), an image for each of its colours; `composed` makes red, green and blue
    of them.
    """
    renderer = renderer or MergeRenderer(context.in_order)
    (panorama,) = render_tiles(renderer, source, trajectory, span, [Tile(0, 0, canvas)], tolerance_px, context)
    return panorama


def render_tiles(
    renderer: Renderer,
    source: Source,
    trajectory: Trajectory,
    span: FrameSpan,
    tiles: Sequence[Tile],
    tolerance_px: float,
    context: Context,
) -> Iterator[Panorama]:
    """Render the tiles of a canvas, one after the other: see `render`."""
    # The panorama of the residuals is merged, and may lie on the same canvas as that of another renderer.
    step = "tile" if isinstance(renderer, MergeRenderer) else "rendered tile"
    with context.progress.stage("panorama", len(span) * len(tiles) * channels_of(source), "frames") as advance:

        def of_colour(canvas: Canvas, each: Source) -> Panorama:
            return renderer.render(each, trajectory, span, canvas, tolerance_px, advance)

        homographies = trajectory.at(np.arange(span.start, span.stop))
        for tile in tiles:
            rendered = partial(in_colours, source, partial(of_colour, tile.canvas))
            yield context.checkpoints.once(step, rendered, homographies, span, tile.canvas)


class Thumbnail:
    """A panorama downscaled by a whole factor, put together tile by tile; with a factor of 1, it is the only tile."""

    def __init__(self, canvas: Canvas, reduction: int) -> None:
        self._reduction = reduction
        self._n_pixels, self._n_seen = canvas.height * canvas.width, 0
        self._shape = -(-canvas.height // reduction), -(-canvas.width // reduction)
        empty = np.zeros((0, 0), np.float32)
        self.panorama = Panorama(empty, empty, rescaling(1 / reduction) @ canvas.transform)
        self.std: FluxImage = empty  # standard deviation of the flux of a pixel

    def add(self, tile: Tile, rendered: Panorama, std: FluxImage) -> None:
        """Add a tile: the mean flux and deviation of the seen pixels, and the mean weight of all pixels of each square."""
        step = self._reduction
        seen = np.isfinite(rendered.flux)
        self._n_seen += int(np.count_nonzero(seen_in(rendered)))
        if step == 1:
            self.panorama, self.std = rendered, std
            return
        seen_share = _averaged(seen, step)
        height, width = seen_share.shape[:2]
        if not self.panorama.flux.size:
            empty = np.zeros((*self._shape, *seen_share.shape[2:]), np.float32)
            self.panorama, self.std = replace(self.panorama, flux=empty, weight=empty.copy()), empty.copy()
        box = np.s_[tile.top // step : tile.top // step + height, tile.left // step : tile.left // step + width]
        for whole, image in ((self.panorama.flux, rendered.flux), (self.std, std)):
            mean = _averaged(np.where(seen, image, 0), step)
            whole[box] = np.divide(mean, seen_share, out=np.full_like(mean, np.nan), where=seen_share > 0)
        self.panorama.weight[box] = _averaged(rendered.weight, step)

    @property
    def coverage_share(self) -> float:
        """Share of the canvas that was seen."""
        return self._n_seen / self._n_pixels


def _averaged(image: NDArray[np.generic], step: int) -> FluxImage:
    """Average squares of pixels; the image is padded with 0 to whole squares at the right and at the bottom."""
    height, width, *colours = image.shape
    padding = [(0, -height % step), (0, -width % step), *[(0, 0) for _ in colours]]
    padded = np.pad(image, padding).astype(np.float32, copy=False)
    blocks = padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step, *colours)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class RenderedPanorama:
    """A panorama whose tiles have been written."""

    canvas: Canvas  # pixel grid of the whole panorama
    thumbnail: Panorama  # flux and weight, averaged down by `reduction`
    reduction: int  # side of the squares of pixels that are averaged; 1 if the panorama fits into memory
    picture: NDArray[np.uint8]  # (H, W) or (H, W, 3) uint8, red first, the thumbnail in sRGB
    white_flux: float  # flux that is white in the picture, photons per pixel per frame
    coverage_share: float  # share of the pixels that were seen
    seconds: float  # time of rendering and writing
    std: FluxImage  # of the flux of a pixel, averaged down as the thumbnail
    dynamic_range: DynamicRange  # the range of flux, with what its noise depends on
