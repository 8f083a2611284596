"""The panorama: every frame whose motion is known, warped onto one canvas and estimated once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.context import Context
from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.geometry import Canvas, canvas_of, rescaling, translation
from photonpano.merging import accumulate, chunks_of
from photonpano.protocols import Source, Trajectory
from photonpano.values import FluxImage, FrameSpan, Panorama

BYTES_PER_PIXEL = 40
"""Peak memory for each pixel that is rendered at a time: sums, estimate and what is written, as measured in the tests."""
LARGEST = 16
"""A panorama that is so many times as large as what fits into the memory is refused: it mostly comes of a wrong motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A part of a canvas.

    Attributes:
        left: columns of the canvas to the left of it.
        top: rows of the canvas above it.
        canvas: its own pixel grid.
    """

    left: int
    top: int
    canvas: Canvas


def plan_canvas(trajectory: Trajectory, span: FrameSpan, frame_shape: tuple[int, int], scale: float, memory: int) -> Canvas:
    """Choose the canvas that holds every frame of a span, before anything of its size is allocated.

    Args:
        trajectory: the motion, frame pixels to reference pixels.
        span: the frames that are to be seen.
        frame_shape: (height, width) of a frame.
        scale: pixels of the canvas per pixel of the reference frame.
        memory: bytes that rendering may take.

    Raises:
        CanvasTooLargeError: it is `LARGEST` times as large as what fits, or more; the message says how large.
        LocationError: frames reach the horizon of the reference plane.
    """
    homographies = trajectory.at(np.arange(span.start, span.stop))
    try:
        canvas = canvas_of(homographies, frame_shape, scale)
    except ValueError as error:
        raise LocationError(
            f"the motion turns so far away from the reference frame that a flat panorama cannot show it ({error}); "
            "choose a render.reference in the middle of the motion, or fewer frames"
        ) from error
    excess = canvas.height * canvas.width * BYTES_PER_PIXEL / memory
    if excess > LARGEST:
        fitting = scale * np.sqrt(LARGEST / excess)
        raise CanvasTooLargeError(
            f"the panorama would have {canvas.width} x {canvas.height} pixels, {excess:.0f} times what the {_gib(memory)} of "
            f"run.memory hold. Up to {LARGEST} times is rendered in parts; more is often a sign of a wrong motion. "
            f"Raise run.memory, lower render.scale from {scale:g} to {_rounded_down(fitting):g}, "
            "or choose a render.reference nearer to the middle of the motion"
        )
    return canvas


def tiles_of(canvas: Canvas, memory: int) -> tuple[tuple[Tile, ...], int]:
    """Divide a canvas across its longer side into tiles that are rendered one by one within the memory.

    Returns:
        The tiles, one if the canvas fits as it is; and by what factor an overview of it is smaller that fits beside them.
        Tiles begin at multiples of that factor.
    """
    fits = memory // BYTES_PER_PIXEL
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
        tiles.append(Tile(left, top, Canvas(height, width, translation(-left, -top) @ canvas.transform)))
    return tuple(tiles), reduction


def render(
    source: Source,
    trajectory: Trajectory,
    span: FrameSpan,
    canvas: Canvas,
    tolerance_px: float,
    context: Context,
) -> Panorama:
    """Merge the frames of a span on a canvas: warped, summed, and one maximum-likelihood estimate for each pixel.

    Args:
        source: the capture.
        trajectory: frame pixels to reference pixels.
        span: the frames that are merged.
        canvas: the pixel grid.
        tolerance_px: frames that move less than this are summed before they are warped.
        context: threads and progress.
    """
    (panorama,) = render_tiles(source, trajectory, span, [Tile(0, 0, canvas)], tolerance_px, context)
    return panorama


def render_tiles(
    source: Source,
    trajectory: Trajectory,
    span: FrameSpan,
    tiles: Sequence[Tile],
    tolerance_px: float,
    context: Context,
) -> Iterator[Panorama]:
    """Render the tiles of a canvas, one after the other: see `render`."""
    chunks = chunks_of(span, trajectory, source.info.frame_shape, tolerance_px)
    with (
        context.progress.stage("panorama", len(span) * len(tiles), "frames") as advance,
        ThreadPoolExecutor(context.threads, thread_name_prefix="render") as pool,
    ):
        for tile in tiles:
            grid = tile.canvas
            photons = accumulate(source, chunks, grid.transform, grid.shape, advance, pool, context.threads)
            yield Panorama(*photons.estimate(source.response), grid.transform)


class Overview:
    """Gathers tiles into a panorama that is smaller by a whole factor.

    Args:
        canvas: what the tiles are parts of.
        reduction: so many pixels squared become one; tiles begin at multiples of it. 1 keeps the only tile as it is.
    """

    def __init__(self, canvas: Canvas, reduction: int) -> None:
        self._reduction = reduction
        self._n_pixels, self._n_seen = canvas.height * canvas.width, 0
        shape = -(-canvas.height // reduction), -(-canvas.width // reduction)
        to_overview = rescaling(1 / reduction) @ canvas.transform
        empty = np.zeros((0, 0) if reduction == 1 else shape, np.float32)
        self.panorama = Panorama(empty, empty.copy(), to_overview)

    def add(self, tile: Tile, rendered: Panorama) -> None:
        """Enter a tile: the mean flux of the pixels that were seen, and the mean weight of all."""
        step = self._reduction
        known = rendered.weight > 0
        self._n_seen += int(np.count_nonzero(known))
        if step == 1:
            self.panorama = rendered
            return
        share = _averaged(known, step)
        height, width = share.shape
        box = np.s_[tile.top // step : tile.top // step + height, tile.left // step : tile.left // step + width]
        flux = _averaged(np.where(known, rendered.flux, 0), step)
        self.panorama.flux[box] = np.divide(flux, share, out=np.full_like(flux, np.nan), where=share > 0)
        self.panorama.weight[box] = _averaged(rendered.weight, step)

    @property
    def coverage_share(self) -> float:
        """The share of the canvas that was seen."""
        return self._n_seen / self._n_pixels


def _averaged(image: NDArray[np.generic], step: int) -> FluxImage:
    """Average squares of pixels; what a square lacks at the right and at the bottom counts as zero."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % step), (0, -width % step))).astype(np.float32, copy=False)
    blocks = padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))


def _gib(size: float) -> str:
    return f"{size / 1024**3:.2g} GiB"


def _rounded_down(scale: float) -> float:
    """Round down to two digits, so that the suggested scale fits."""
    digit = 10.0 ** (np.floor(np.log10(scale)) - 1)
    return float(np.floor(scale / digit) * digit)
