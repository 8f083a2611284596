"""Choose the canvas of a panorama, its projection and what it holds, and render it.

The canvas is divided into tiles that fit into memory, and all located frames are merged on each.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Renderer, Source, Trajectory
from photonpano.errors import CanvasTooLargeError, ExtentError, LocationError, ProjectionError
from photonpano.execution.context import Context
from photonpano.execution.threads import InOrder
from photonpano.geometry import (
    PROJECTIONS,
    Camera,
    Canvas,
    Covered,
    Extent,
    canvas_around,
    canvas_of,
    canvas_of_box,
    covered_by,
    inverse,
    level_horizon,
    outline_of,
    rescaling,
    transform_points,
)
from photonpano.merging.accumulate import accumulate, chunks_of
from photonpano.merging.canvas_noise import DynamicRange
from photonpano.merging.colour import channels_of, in_colours, seen_in
from photonpano.photometry import debiased
from photonpano.values import FloatArray, FluxImage, FrameSpan, Panorama

BYTES_PER_PIXEL = 40  # peak memory of merging, per pixel of a tile: sums, estimate and output, as measured in the tests
# A canvas is refused above this many times the size that fits into memory: the motion is then wrong, most of the time.
_MAX_EXCESS = 16
_LEAST_SCALE = 0.05  # that render.scale may have
# Up to the first field of view, "auto" takes a plane; beyond the second, a plane is refused.
_PLANAR_DEGREES, _WIDEST_PLANE_DEGREES = 90, 100
_CYLINDER_DEGREES = 45  # up to this distance from b = 0, "auto" takes a cylinder
_ROUNDING_DEGREES = 1e-6
_TURN = 360


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """How a panorama is projected."""

    projection: str = "auto"  # one of `PROJECTIONS`, or "auto"
    level: bool = False  # whether the horizon is level, or that of the reference frame
    camera: Camera | None = None  # of the frames; None if it is not known
    turns: bool = False  # whether the camera only turns, so that a cylinder or a sphere can show what it sees


def plan_canvas(  # noqa: PLR0917
    trajectory: Trajectory,
    span: FrameSpan,
    frame_shape: tuple[int, int],
    scale: float,
    memory: int,
    bytes_per_pixel: int = BYTES_PER_PIXEL,
    extent: Extent = "panorama",
    view: View | None = None,
) -> Canvas:
    """Choose the canvas that holds every frame of a span, or a part of it, before anything of its size is allocated.

    `scale` is pixels of the canvas per pixel of the reference frame, `memory` the bytes that rendering may take, of which a
    pixel takes `bytes_per_pixel`. A box is in pixels of the reference frame on a plane, and in degrees of a and b otherwise;
    without a view, the canvas is a plane.

    Raises:
        ExtentError: no frame shows the extent.
        CanvasTooLargeError: the canvas has more than `_MAX_EXCESS` times the pixels that fit into memory; the message suggests
            a scale that fits, if there is one.
        LocationError: frames reach the horizon of the reference plane.
        ProjectionError: the motion does not suit the projection.
    """
    view = view or View("planar")
    homographies = trajectory.at(np.arange(span.start, span.stop))
    canvas = _canvas(homographies, frame_shape, scale, extent, view)
    excess = canvas.height * canvas.width * bytes_per_pixel / memory
    if excess > _MAX_EXCESS:
        fitting = scale * np.sqrt(_MAX_EXCESS / excess)
        digit = 10.0 ** (np.floor(np.log10(fitting)) - 1)  # two are significant; rounded down, the suggestion fits
        suggested = float(np.floor(fitting / digit) * digit)
        lower = f"lower render.scale from {scale:g} to {suggested:g}, " if suggested >= _LEAST_SCALE else ""
        raise CanvasTooLargeError(
            f"the panorama would have {canvas.height}x{canvas.width} px, {excess:.0f} times what fits into the "
            f"{memory / 1024**3:.2g} GiB of run.memory; up to {_MAX_EXCESS} times is rendered in tiles. "
            f"More often means that the motion is wrong. Raise run.memory, {lower}or choose a render.reference nearer to the "
            "middle of the motion"
        )
    return canvas


def box_of(extent: Extent, frame_shape: tuple[int, int]) -> tuple[int, int, int, int]:
    """Return the box of a part of a planar panorama, not of the whole one, in pixels of the reference frame."""
    return (0, 0, *frame_shape[::-1]) if isinstance(extent, str) else extent


def _canvas(homographies: FloatArray, frame_shape: tuple[int, int], scale: float, extent: Extent, view: View) -> Canvas:
    if not view.turns or view.camera is None:
        if view.projection not in ("auto", "planar"):
            raise ProjectionError(
                f"a {view.projection} panorama needs a camera that only turns, and this motion is one homography a frame; "
                "write motion: {model: rotation}, or render.projection: planar"
            )
        return _plane(homographies, frame_shape, scale, extent=extent, camera=view.camera)
    rotations, horizon = view.camera.rotations(homographies), None
    covered = covered_by(rotations, view.camera, frame_shape)
    projection = view.projection if view.projection != "auto" else _suitable(covered, extent)
    if projection == "planar":
        if extent == "panorama" and np.degrees(covered.field_of_view) > _WIDEST_PLANE_DEGREES:
            raise ProjectionError(
                f"the frames cover {np.degrees(covered.field_of_view):.0f} degrees, and a plane holds up to "
                f"{_WIDEST_PLANE_DEGREES}; write render.projection: {_suitable(covered, extent)}"
            )
        return _plane(homographies, frame_shape, scale, extent=extent, camera=view.camera, turns=True)
    if view.level:
        horizon = level_horizon(rotations)
        covered = covered_by(horizon @ rotations, view.camera, frame_shape)
    low, high = np.degrees(covered.b) if isinstance(extent, str) else (extent[1], extent[3])
    first, last = np.degrees(covered.a) if isinstance(extent, str) else (extent[0], extent[2])
    for reached, widest, where in zip(
        (max(-first, last), max(-low, high)), PROJECTIONS[projection].widest, ("aside", "up or down"), strict=True
    ):
        if reached > widest + _ROUNDING_DEGREES:  # far larger than what it shows
            raise ProjectionError(
                f"the frames reach {reached:.0f} degrees {where}, and a {projection} panorama holds up to {widest:g}; write "
                "render.projection: spherical"
            )
    whole = canvas_around(covered, view.camera, scale, projection, horizon)
    if extent == "panorama":
        return whole
    if isinstance(extent, str):
        own = covered_by(np.eye(3)[None] if horizon is None else horizon[None], view.camera, frame_shape)
        return canvas_around(own, view.camera, scale, projection, horizon)
    return _part_around(whole, covered, extent)


def _suitable(covered: Covered, extent: Extent) -> str:
    """Return the projection that suits what frames cover."""
    if extent == "reference" or np.degrees(covered.field_of_view) <= _PLANAR_DEGREES:
        return "planar"
    return "cylindrical" if np.degrees(max(-covered.b[0], covered.b[1])) < _CYLINDER_DEGREES else "spherical"


def _plane(
    homographies: FloatArray,
    frame_shape: tuple[int, int],
    scale: float,
    *,
    extent: Extent,
    camera: Camera | None,
    turns: bool = False,
) -> Canvas:
    if extent != "panorama" and turns:
        # Frames beside and behind the plane do not matter to a part of it.
        return canvas_of_box(box_of(extent, frame_shape), scale)
    outline = camera.ideal(outline_of(frame_shape)) if camera is not None and camera.distorts else None
    try:
        whole = canvas_of(homographies, frame_shape, scale, outline)
    except ValueError as error:
        raise LocationError(
            f"the motion turns so far away from the reference frame that a flat panorama cannot show it ({error}); "
            "choose a render.reference in the middle of the motion, or fewer frames"
        ) from error
    return whole if extent == "panorama" else _part_of(whole, box_of(extent, frame_shape), scale)


def _part_of(whole: Canvas, box: tuple[int, int, int, int], scale: float) -> Canvas:
    """Return the canvas of a box in pixels of the reference frame; an `ExtentError` if it lies outside the whole canvas."""
    part = canvas_of_box(box, scale)
    ends = np.array([[0.0, 0.0], [whole.width - 1, whole.height - 1]])
    (left, top), (right, bottom) = np.rint(transform_points(inverse(whole.transform), ends)).astype(int).reshape(2, 2).tolist()
    x0, y0, x1, y1 = box
    if x1 <= left or x0 > right or y1 <= top or y0 > bottom:
        raise ExtentError(
            f"[{x0}, {y0}, {x1}, {y1}] lies outside the panorama, which holds x from {left} to {right} and "
            f"y from {top} to {bottom}, in pixels of the reference frame"
        )
    return part


def _part_around(whole: Canvas, covered: Covered, box: tuple[int, int, int, int]) -> Canvas:
    """Return the part of a canvas of a cylinder or a sphere between a0, b0 and a1, b1 in degrees, or raise an `ExtentError`."""
    a0, b0, a1, b1 = box
    (first, last), (low, high) = np.degrees(covered.a), np.degrees(covered.b)
    if a1 - a0 > _TURN or b0 < -_TURN / 4 or b1 > _TURN / 4:
        raise ExtentError(
            f"{list(box)} is in degrees on a {whole.projection} panorama: expected a0, b0, a1, b1 with a1 - a0 up to {_TURN} "
            f"and b0 and b1 from {-_TURN // 4} (up) to {_TURN // 4} (down)"
        )
    beside = not any(a0 < last + turn and a1 > first + turn for turn in (-_TURN, 0, _TURN)) and not covered.full_turn
    if beside or b0 >= high or b1 <= low:
        raise ExtentError(
            f"{list(box)} lies outside the panorama, which holds a from {first:.0f} to {last:.0f} and b from {low:.0f} to "
            f"{high:.0f}, in degrees"
        )
    bounds = PROJECTIONS[whole.projection].bounds((np.radians(a0), np.radians(a1)), (np.radians(b0), np.radians(b1)))
    across, down = (bounds * whole.transform[0, 0]).T
    (left, right), (top, bottom) = ((int(np.floor(start + 1e-6)), int(np.ceil(stop - 1e-6))) for start, stop in (across, down))
    origin = np.rint(whole.transform[:2, 2] + 0.5).astype(int)
    return whole.part(left + int(origin[0]), top + int(origin[1]), bottom - top, right - left)


class MergeRenderer:
    """Warps the photons of all frames to the canvas, and estimates the flux of each pixel once (paper, equation 3)."""

    def __init__(self, in_order: InOrder) -> None:
        """Take what works on several parts at once, such as that of a `StageContext`; the result does not depend on it."""
        self._in_order = in_order

    def render(  # noqa: PLR0917
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


def render(  # noqa: PLR0917
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
    (panorama,) = render_tiles(
        renderer, source, trajectory, span, tiles=[Tile(0, 0, canvas)], tolerance_px=tolerance_px, context=context
    )
    return panorama


def render_tiles(  # noqa: PLR0917
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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
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
    # (2, h, w) the first and the last frame that saw pixels, every `reduction`th of them: see `seen_frames`
    seen_frames: NDArray[np.uint32]
    dynamic_range: DynamicRange  # the range of flux, with what its noise depends on
    never_seen_share: float = 0.0  # share whose background no frame showed
