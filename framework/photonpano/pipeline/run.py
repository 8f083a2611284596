"""One run, from the capture to the run folder."""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.captures.summary import require_photons
from photonpano.compiling import notify_on_first_compile
from photonpano.context import Context, Progress
from photonpano.corrections import CorrectedSource
from photonpano.errors import InputError
from photonpano.geometry import Canvas
from photonpano.merging.panorama import Thumbnail, Tile, plan_canvas, render_tiles, tiles_of
from photonpano.motion.loop import estimate_motion
from photonpano.photometry import tone_mapped
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.observers import NOBODY, Observers
from photonpano.pipeline.record import (
    level_record,
    levels_decision,
    library_versions,
    motion_record,
    peak_memory_bytes,
    plugin_records,
    source_record,
    uncertain_frames,
    warnings_of,
)
from photonpano.pipeline.run_folder import RunFolder
from photonpano.protocols import Source
from photonpano.specs.plan import Plan
from photonpano.specs.tree import Place
from photonpano.threads import one_thread_inside, thread_count
from photonpano.values import BoolArray, FloatArray, Panorama

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(frozen=True, slots=True, eq=False)
class RunOutcome:
    """What a run found, and what it records of itself.

    Attributes:
        canvas: the pixel grid of the panorama.
        panorama: flux and weight on the canvas, averaged down where it was rendered in tiles.
        homographies: (T, 3, 3), frame pixels to reference pixels.
        located: (T,), False where a frame lies outside what was located.
        std_px: (T,) expected corner error, infinite where a frame lies outside what was located.
        reference: the frame whose homography is the identity.
        record: the content of `run.json`.
    """

    canvas: Canvas
    panorama: Panorama
    homographies: FloatArray
    located: BoolArray
    std_px: FloatArray
    reference: int
    record: dict[str, Any]

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The panorama in sRGB, (H, W) uint8."""
        return tone_mapped(self.panorama.flux, self.record["panorama"]["white_flux"])


def _forget(tile: Tile, rendered: Panorama, canvas: Canvas) -> None:
    """Keep nothing but the overview."""


def execute(
    plan: Plan,
    source: Source,
    version: str,
    progress: Progress,
    observers: Observers = NOBODY,
    keep: Callable[[Tile, Panorama, Canvas], None] = _forget,
) -> RunOutcome:
    """Run a plan on its open source: the loop, then the panorama.

    Args:
        plan: which components.
        source: the capture.
        version: of photonpano, for the record.
        progress: is told of the stages.
        observers: are told of them when they are done.
        keep: is given the panorama tile by tile, each with the canvas that it is a part of.

    Raises:
        InputError: the capture shows nothing, or does not suit the plan.
        LocationError: the motion could not be found.
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        PluginError: a component failed in its own way, or broke its contract.
    """
    start = time.perf_counter()
    corrected = source if isinstance(source, CorrectedSource) else None
    context = Context(thread_count(plan.run.threads), progress, observers.level_finished)
    stream = source.info
    reference = _reference_frame(plan, stream.n_frames)
    try:
        require_photons(source)
    except InputError as error:
        # The source knows its file, the spec knows where that is named.
        raise InputError(str(plan.places.get("source", Place("source")).problem(str(error)))) from error
    decisions = [*plan.decisions, *(corrected.decisions if corrected else ())]
    levels = build_levels(plan, source, decisions)
    with one_thread_inside(), notify_on_first_compile(partial(progress.note, COMPILING)):
        results = estimate_motion(source, levels, plan.graph, reference, context, plan.until_converged)
    if plan.until_converged:
        decisions.append(levels_decision(results))
    trajectory = results[-1].trajectory
    rendering = time.perf_counter()
    covered = results[-1].located.covered
    canvas = plan_canvas(trajectory, covered, stream.frame_shape, plan.render.scale, int(plan.run.memory))
    tiles, reduction = tiles_of(canvas, int(plan.run.memory))
    shown = Thumbnail(canvas, reduction)
    with one_thread_inside():
        rendered = render_tiles(source, trajectory, covered, tiles, plan.render.tolerance_px, context)
        for tile, part in zip(tiles, rendered, strict=True):
            keep(tile, part, canvas)
            shown.add(tile, part)
    panorama = shown.panorama
    observers.rendered(canvas, time.perf_counter() - rendering)
    seen = panorama.weight > 0
    white_flux = float(np.quantile(panorama.flux[seen], plan.render.white_quantile)) or 1.0
    frames = np.arange(stream.n_frames)
    located = (covered.start <= frames) & (frames < covered.stop)
    std_px = np.where(located, results[-1].uncertainty.at(frames), np.inf)
    warnings = warnings_of(results) + uncertain_frames(std_px)
    if not located.all():
        warnings.append(f"{np.sum(~located)} of {stream.n_frames} frames lie outside what was located and are left out")
    now = time.perf_counter()
    record = {
        "photonpano": version,
        "status": "done",
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "spec": plan.document,
        "spec_file": None if plan.file is None else str(plan.file),
        "seed": plan.run.seed,
        "source": source_record(stream),
        "plugins": plugin_records(plan),
        "libraries": library_versions(plan),
        "decisions": [asdict(decision) for decision in decisions],
        "levels": [level_record(result) for result in results],
        "panorama": {
            "height": canvas.height,
            "width": canvas.width,
            "scale": plan.render.scale,
            "picture_reduction": reduction,
            "white_flux": white_flux,
            "coverage_share": shown.coverage_share,
            "seconds": round(now - rendering, 3),
        },
        "motion": motion_record(std_px),
        "warnings": warnings,
        "seconds": round(now - start, 3),
        "peak_memory_bytes": peak_memory_bytes(),
    }
    return RunOutcome(canvas, panorama, trajectory.at(frames), located, std_px, reference, record)


def write_outcome(folder: RunFolder, outcome: RunOutcome, frame_shape: tuple[int, int]) -> None:
    """Write everything but the report and the panorama's flux and weight into a run folder."""
    folder.write_picture(outcome.picture)
    folder.write_trajectory(
        outcome.homographies, outcome.located, outcome.std_px, outcome.canvas.transform, frame_shape, outcome.reference
    )
    folder.write_record(outcome.record)


def _reference_frame(plan: Plan, n_frames: int) -> int:
    named = {"first": 0, "middle": n_frames // 2, "last": n_frames - 1}
    reference = plan.render.reference
    return named[reference] if isinstance(reference, str) else reference
