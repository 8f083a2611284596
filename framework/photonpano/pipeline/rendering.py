"""Render the panorama along a known motion, and write it in all formats; what renderers and exporters return is checked."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.attribution import attributing, blaming, label_of
from photonpano.contracts.protocols import Exporter, Renderer, Source, Trajectory, camera_of, light_of
from photonpano.contracts.requirements import BrokenContract, require_files
from photonpano.corrections import Vignette, write_vignette
from photonpano.corrections.lighting import write_light
from photonpano.corrections.movers import showing, write_background
from photonpano.errors import ExtentError, InputError, OutputError, ProjectionError
from photonpano.execution.context import Context
from photonpano.execution.threads import InOrder
from photonpano.geometry import Canvas
from photonpano.merging.accumulate import bytes_of_light
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano.merging.colour import channels_of, composed
from photonpano.merging.panorama import BYTES_PER_PIXEL, RenderedPanorama, Thumbnail, plan_canvas, render_tiles, tiles_of
from photonpano.merging.seen_frames import seen_frames
from photonpano.merging.warping import by_homographies
from photonpano.motion.frame_motion import FrameMotion, view_of
from photonpano.motion.level import Recorder
from photonpano.photometry import balanced, picture_of
from photonpano.pipeline.components import built, stage_context
from photonpano.pipeline.run_folder import RunFolder
from photonpano.plugins.contributions import ExporterContribution, RendererContribution
from photonpano.record.contents import HALVES, name_of_capture
from photonpano.residuals.detail import Detail
from photonpano.residuals.halves import detail_between, halves_in_time, reduced
from photonpano.specs.plan import Plan
from photonpano.values import FrameSpan, Homography, Journal, Panorama, PanoramaRows

logger = logging.getLogger(__name__)


def render_into(
    folder: RunFolder, plan: Plan, source: Source, *, vignette: Vignette | None, motion: FrameMotion, context: Context
) -> tuple[RenderedPanorama, Journal]:
    """Render the panorama, and write it, its motion, and what its capture was divided by. For errors, see `run`.

    `source` is divided by the vignette and in its light. Returns the panorama, and the decisions of renderer and exporters.
    """
    background = capture_of(source).background
    source, decisions, never_seen_share = showing(source, motion.trajectory, motion.camera, plan.render.movers)
    renderer = build_renderer(plan, source, decisions, context.in_order)
    exporters = build_exporters(plan, source, decisions)
    with naming_key_of_canvas(plan):
        panorama = _rendered(folder, plan, source, motion=motion, context=context, renderer=renderer)
    renderer.require_seen(panorama.coverage_share)
    folder.write_results(panorama, motion)
    for exporter in exporters:
        exporter.export(StoredPanorama.of(folder.staging, panorama, name_of_capture(plan)), folder.staging)
    with folder.writing():
        if vignette is not None:
            write_vignette(folder.staging, vignette)
        if (light := light_of(source)) is not None:
            write_light(folder.staging, light)
        if background is not None:
            write_background(folder.staging, background)
    return replace(panorama, never_seen_share=never_seen_share), decisions


def _rendered(
    folder: RunFolder, plan: Plan, source: Source, *, motion: FrameMotion, context: Context, renderer: ChosenRenderer
) -> RenderedPanorama:
    """Render the frames of a motion, in tiles if the panorama exceeds the memory, and write these."""
    start, settings, memory = time.perf_counter(), plan.render, int(plan.run.memory)
    bytes_per_pixel = (renderer.bytes_per_pixel + bytes_of_light(source)) * channels_of(source)
    view = view_of(motion, source, settings.projection, level=settings.horizon == "level")
    shown = motion.trajectory, motion.span, source.info.frame_shape
    canvas = plan_canvas(*shown, settings.scale, memory, bytes_per_pixel, settings.extent, view)
    tiles, reduction = tiles_of(canvas, memory, bytes_per_pixel)
    noise = CanvasNoise.of(source, motion.trajectory, motion.span, canvas, motion.std_px)
    gathered, dynamic_range, seen = Thumbnail(canvas, reduction), DynamicRange(noise=noise), []
    rendered = render_tiles(
        renderer, source, motion.trajectory, motion.span, tiles=tiles, tolerance_px=settings.tolerance_px, context=context
    )
    for tile, images in zip(tiles, rendered, strict=True):
        part = composed(images, source)
        std = np.empty_like(part.flux)
        for rows, found in noise.of_tile(part.flux, part.weight, tile.top, tile.left):
            dynamic_range.add(part.flux[rows], part.weight[rows], found.photons)
            std[rows] = found.whole
        frames = seen_frames(source, motion.trajectory, motion.span, tile.canvas)
        folder.write_tile(tile, (part.flux, part.weight, std, *frames), canvas, name_of_capture(plan))
        gathered.add(tile, part, std)
        seen.append(frames[:, ::reduction, ::reduction])
    if settings.extent != "panorama" and not gathered.coverage_share:
        raise ExtentError("no frame that was located shows it; choose a part of the panorama")
    thumbnail = gathered.panorama
    lit_picture = balanced(thumbnail.flux, settings.white_balance)
    lit = lit_picture[np.isfinite(lit_picture)]
    white_flux = (float(np.quantile(lit, settings.white_quantile)) if lit.size else 0.0) or 1.0
    picture = picture_of(lit_picture, white_flux, settings.tone, settings.exposure_stops)
    return RenderedPanorama(
        canvas=canvas,
        thumbnail=thumbnail,
        reduction=reduction,
        picture=picture,
        white_flux=white_flux / 2**settings.exposure_stops,
        coverage_share=gathered.coverage_share,
        seconds=time.perf_counter() - start,
        std=gathered.std,
        seen_frames=np.concatenate(seen, axis=2 if canvas.width > canvas.height else 1),
        dynamic_range=dynamic_range,
    )


def write_halves(
    folder: RunFolder, plan: Plan, source: Source, *, motion: FrameMotion, canvas: Canvas, context: Context
) -> Detail:
    """Write the panoramas of the first and the last half of the frames that saw each place; return the detail that they share.

    They lie on the canvas of the panorama, or on the largest that fits into memory.
    """
    canvas = reduced(canvas, int(plan.run.memory) / (BYTES_PER_PIXEL * channels_of(source)))
    sums = halves_in_time(source, motion, canvas, plan.render.tolerance_px, context)
    for name, (lit, weight) in zip(HALVES, sums.squeeze(-1) if sums.shape[-1] == 1 else sums, strict=True):
        flux = np.divide(lit, weight, out=np.full_like(lit, np.nan), where=weight > 0)
        half = composed(Panorama(flux, weight, canvas.transform), source)
        with folder.writing():
            tifffile.imwrite(folder.staging / name, half.flux, metadata=None)
    return detail_between(sums, source, motion, canvas)


@contextmanager
def naming_key_of_canvas(plan: Plan) -> Iterator[None]:
    """Refuse a canvas that cannot be planned, with the key of the spec that it does not suit."""
    try:
        yield
    except (ExtentError, ProjectionError) as error:
        key = "render.extent" if isinstance(error, ExtentError) else "render.projection"
        raise plan.error(key, str(error)) from error


@dataclass(frozen=True, slots=True)
class ChosenRenderer:
    """The renderer of a plan. Unless it renders on `any_canvas`, it needs a planar one and a lens without distortion."""

    component: Renderer
    bytes_per_pixel: int
    any_canvas: bool = True

    def render(  # noqa: PLR0917
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Render the frames of a span on a canvas; `InputError` if it renders no such canvas, or not through a lens."""
        self._require_renderable(source, trajectory, span, canvas)
        return self.component.render(source, trajectory, span, canvas, tolerance_px, advance)

    def _require_renderable(self, source: Source, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> None:
        """Refuse what only a renderer on any canvas renders."""
        if self.any_canvas:
            return
        label = label_of(self.component)
        if not canvas.planar:
            raise InputError(
                f"{label} renders on a plane only, and this panorama is {canvas.projection}; write render.use: merge, or "
                "render.projection: planar"
            )
        camera = camera_of(source)
        if camera is not None and camera.distorts:
            raise InputError(f"{label} does not render through a lens that distorts; write render.use: merge")
        homographies = trajectory.at(np.arange(span.start, span.stop))
        if not by_homographies(canvas, camera, homographies, source.info.frame_shape):
            raise InputError(f"{label} does not leave out frames that reach behind the plane; write render.use: merge")

    def require_seen(self, coverage_share: float) -> None:
        """Raise `PluginError` if nothing of the panorama was seen, although frames were located."""
        if not coverage_share:
            with blaming(self.component):
                raise BrokenContract("no pixel has a positive weight")


def build_renderer(plan: Plan, source: Source, decisions: Journal, in_order: InOrder | None = None) -> ChosenRenderer:
    """Build the renderer of a plan; `decisions` receives its choices. Without `in_order`, threads share the work."""
    choice, contribution = plan.renderer, plan.renderer.contribution
    context = stage_context(plan, source, Recorder(decisions))
    if in_order is not None:
        context = replace(context, in_order=in_order)
    assert isinstance(contribution, RendererContribution)
    if light_of(source) is not None and not contribution.divides_by_light:
        logger.warning(
            f"{choice.label} does not divide by the light, which changes: the panorama shows each place in the mean light of "
            "the frames that saw it; render with {use: merge} to divide by it"
        )
    any_canvas = contribution.renders_on_any_canvas
    return ChosenRenderer(built(choice, context, "the panorama"), contribution.bytes_per_pixel, any_canvas)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StoredPanorama:
    """The files of a rendered panorama: a `FinishedPanorama`."""

    flux: NDArray[np.float32]  # (H, W) or (H, W, 3) float32, on disk
    weight: NDArray[np.float32]  # the same shape, on disk
    std: NDArray[np.float32]  # the same shape, on disk
    canvas: Homography  # (3, 3), pixels of the reference plane to pixels of the panorama: see `FinishedPanorama`
    white_flux: float  # flux that is white in the picture
    noise: CanvasNoise
    projection: str = "planar"
    capture: str = ""  # name of its file

    @classmethod
    def of(cls, folder: Path, panorama: RenderedPanorama, capture: str = "") -> StoredPanorama:
        """Open the maps of a panorama in a folder."""
        flux, weight, std = (
            tifffile.memmap(folder / name, mode="r") for name in ("panorama.tiff", "coverage.tiff", "panorama-std.tiff")
        )
        canvas, noise = panorama.canvas, panorama.dynamic_range.noise
        return cls(
            flux=flux,
            weight=weight,
            std=std,
            canvas=canvas.transform,
            white_flux=panorama.white_flux,
            noise=noise,
            projection=canvas.projection,
            capture=capture,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.flux.shape[0], self.flux.shape[1]

    @property
    def in_colour(self) -> bool:
        """Whether pixels have red, green and blue."""
        return self.flux.ndim == 3

    def rows(self, start: int, stop: int) -> PanoramaRows:
        """Return some rows, as arrays of their own."""
        flux, weight, std = (_rows(image, start, stop) for image in (self.flux, self.weight, self.std))
        return PanoramaRows(flux, weight, std, self.noise.saturated(flux, weight))


def _rows(image: NDArray[np.float32], start: int, stop: int) -> NDArray[np.float32]:
    """Copy rows of an image. A file is mapped anew, for what was read of it counts as memory while it stays mapped."""
    if isinstance(image, np.memmap) and image.filename is not None:
        image = np.memmap(image.filename, np.float32, "r", image.offset, image.shape)
    return np.array(image[start:stop], np.float32)


@dataclass(frozen=True, slots=True)
class AttributedExporter:
    """An exporter whose errors name its `origin`, such as "exporter 'exr' of photonpano 0.1.0", and whose result is checked."""

    component: Exporter
    origin: str
    suffix: str

    def export(self, panorama: StoredPanorama, folder: Path) -> None:
        """Write the panorama into a folder; `OutputError` if the file cannot be written, as on a full disk."""
        path = folder / f"panorama{self.suffix}"
        before = {each.name for each in folder.iterdir()}
        with attributing(self.origin, path.name):
            try:
                self.component.export(panorama, path)
            except OSError as error:
                reason = f"{path.name} could not be written ({error.strerror or error})"
                raise OutputError(
                    f"{reason}; what was in the run folder before is unchanged. Make room, or choose another folder with "
                    "--output"
                ) from error
            require_files({each.name for each in folder.iterdir()} - before, path)


def build_exporters(plan: Plan, source: Source, decisions: Journal) -> tuple[AttributedExporter, ...]:
    """Build the exporters of a plan, in order; `decisions` receives their choices."""
    context = stage_context(plan, source, Recorder(decisions))
    exporters = []
    for choice in plan.formats:
        assert isinstance(choice.contribution, ExporterContribution)
        exporters.append(AttributedExporter(built(choice, context), choice.label, choice.contribution.suffix))
    return tuple(exporters)
