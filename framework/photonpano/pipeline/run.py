"""One run, from the capture to the run folder."""

from __future__ import annotations

import datetime
import time
from dataclasses import asdict, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from photonpano.compiling import told_once
from photonpano.errors import InputError
from photonpano.photometry import tone_mapped
from photonpano.pipeline.components import build_levels, origin_of
from photonpano.pipeline.loop import estimate_motion
from photonpano.pipeline.named import NamedSource
from photonpano.pipeline.observers import NOBODY
from photonpano.pipeline.panorama import plan_canvas, render
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
from photonpano.pipeline.threads import one_thread_inside, thread_count
from photonpano.spec.tree import Place
from photonpano.values import Decision, FrameSpan

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.pipeline.observers import Observers
    from photonpano.pipeline.progress import Progress
    from photonpano.pipeline.run_folder import RunFolder
    from photonpano.protocols import Source
    from photonpano.spec.plan import Plan
    from photonpano.values import BoolArray, FloatArray, Panorama

_PROBES = 16
_PROBE_FRAMES = 16


COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(frozen=True, slots=True, eq=False)
class RunOutcome:
    """What a run found, and what it records of itself.

    Attributes:
        panorama: flux and weight on the canvas.
        homographies: (T, 3, 3), frame pixels to reference pixels.
        located: (T,), False where a frame lies outside what was located.
        std_px: (T,) expected corner error, infinite where a frame lies outside what was located.
        reference: the frame whose homography is the identity.
        record: the content of `run.json`.
    """

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


def execute(plan: Plan, source: Source, version: str, progress: Progress, observers: Observers = NOBODY) -> RunOutcome:
    """Run a plan on its open source: the loop, then the panorama.

    Raises:
        InputError: the capture shows nothing, or does not suit the plan.
        LocationError: the motion could not be found.
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        PluginError: a component failed in its own way, or broke its contract.
    """
    start = time.perf_counter()
    source = NamedSource(source, origin_of(plan.source))
    threads = thread_count(plan.run)
    stream = source.info
    reference = _reference_frame(plan, stream.n_frames)
    try:
        require_photons(source)
    except InputError as error:
        # The source knows its file, the spec knows where that is named.
        raise InputError(str(plan.places.get("source", Place("source")).problem(str(error)))) from error
    decisions: list[Decision] = []
    levels = build_levels(plan, source, decisions)
    with one_thread_inside(), told_once(partial(progress.note, COMPILING)):
        results = estimate_motion(source, levels, plan.graph, reference, threads, progress, plan.until_converged, observers)
    if plan.until_converged:
        decisions.append(levels_decision(results))
    trajectory = results[-1].trajectory
    rendering = time.perf_counter()
    covered = results[-1].located.covered
    canvas = plan_canvas(trajectory, covered, stream.frame_shape, plan.render.scale, int(plan.run.memory))
    with one_thread_inside():
        panorama = render(source, trajectory, covered, canvas, plan.render.tolerance_px, threads, progress)
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
            "white_flux": white_flux,
            "coverage_share": float(seen.mean()),
            "seconds": round(now - rendering, 3),
        },
        "motion": motion_record(std_px),
        "warnings": warnings,
        "seconds": round(now - start, 3),
        "peak_memory_bytes": peak_memory_bytes(),
    }
    return RunOutcome(panorama, trajectory.at(frames), located, std_px, reference, record)


def write_outcome(folder: RunFolder, outcome: RunOutcome, frame_shape: tuple[int, int]) -> None:
    """Write everything but the report into a run folder."""
    folder.write_panorama(outcome.panorama, outcome.picture)
    folder.write_trajectory(
        outcome.homographies, outcome.located, outcome.std_px, outcome.panorama.canvas, frame_shape, outcome.reference
    )
    folder.write_record(outcome.record)


def require_photons(source: Source) -> None:
    """Look at a few frames all over the capture, and refuse one that is all dark or all lit.

    Raises:
        InputError: no pixel, or every pixel, is lit in all of them; of grey levels, all are black, or saturated.
    """
    n_frames, valid = source.info.n_frames, source.valid
    spans = [source.info.span]
    if n_frames > _PROBES * _PROBE_FRAMES:
        starts = np.linspace(0, n_frames - _PROBE_FRAMES, _PROBES).astype(int)
        spans = [FrameSpan(int(start), int(start) + _PROBE_FRAMES) for start in starts]
    seen = sum(len(span) for span in spans)
    mean_count = sum(source.counts(span)[valid] for span in spans) / np.float32(seen)
    none, most = source.response.mean_count(np.array([0, np.inf], np.float32)).tolist()
    binary = source.info.kind == "binary"
    if mean_count.max() <= none:
        raise InputError(
            f"no pixel is {'lit' if binary else 'brighter than black'} in any of {seen} frames looked at all over the capture; "
            "check that the file is the right one, and that the lens was open"
        )
    if mean_count.min() >= most:
        raise InputError(
            f"every pixel is {'lit' if binary else 'saturated'} in all of {seen} frames looked at all over the capture, "
            "so that no flux can be told; check the layout of the file, or expose less"
        )


def _reference_frame(plan: Plan, n_frames: int) -> int:
    named = {"first": 0, "middle": n_frames // 2, "last": n_frames - 1}
    reference = plan.render.reference
    return named[reference] if isinstance(reference, str) else reference
