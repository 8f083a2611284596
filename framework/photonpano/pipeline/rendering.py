"""Render the panorama along a known motion, into a run folder."""

from __future__ import annotations

from dataclasses import dataclass

from photonpano.context import Context
from photonpano.corrections import Vignette
from photonpano.errors import ExtentError, InputError, ProjectionError
from photonpano.geometry import Canvas
from photonpano.merging.panorama import RenderedPanorama, render_panorama
from photonpano.motion.frame_motion import FrameMotion, view_of
from photonpano.pipeline.components import build_exporters, build_renderer
from photonpano.pipeline.exports import export_all
from photonpano.pipeline.run_folder import RunFolder
from photonpano.protocols import Source, light_of
from photonpano.specs.plan import Plan
from photonpano.values import Decision, Panorama


@dataclass(frozen=True, slots=True, eq=False)
class Rendering:
    """A panorama whose files are written, and the decisions of renderer and exporters."""

    panorama: RenderedPanorama
    decisions: tuple[Decision, ...]


def render_into(
    folder: RunFolder,
    plan: Plan,
    source: Source,
    vignette: Vignette | None,
    motion: FrameMotion,
    context: Context,
    ready: tuple[Canvas, Panorama] | None = None,
) -> Rendering:
    """Render the panorama, and write it, its motion, and what its capture was divided by.

    `source` is divided by the vignette and in its light. `ready` is the merge of all frames along this motion, where it is
    known.

    Raises:
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        InputError: no frame shows the extent, or the motion does not suit the projection.
        LocationError: frames reach the horizon of the reference plane.
        OutputError: a file cannot be written.
        PluginError: the renderer or an exporter failed, or broke its contract.
    """
    decisions: list[Decision] = []
    renderer = build_renderer(plan, source, decisions, context.in_order)
    exporters = build_exporters(plan, source, decisions)
    try:
        panorama = render_panorama(
            renderer,
            source,
            motion.trajectory,
            motion.span,
            plan.render,
            int(plan.run.memory),
            folder.write_tile,
            context,
            renderer.bytes_per_pixel,
            view_of(motion, source, plan.render.projection, level=plan.render.horizon == "level"),
            ready if renderer.merges else None,
        )
    except ExtentError as error:
        raise InputError(str(plan.place("render.extent").problem(str(error)))) from error
    except ProjectionError as error:
        raise InputError(str(plan.place("render.projection").problem(str(error)))) from error
    renderer.require_seen(panorama.coverage_share)
    folder.write_results(panorama, motion)
    export_all(exporters, folder.staging, panorama)
    if vignette is not None:
        folder.write_vignette(vignette)
    if (light := light_of(source)) is not None:
        folder.write_light(light)
    return Rendering(panorama, tuple(decisions))
