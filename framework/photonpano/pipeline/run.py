"""One run: open the capture, estimate the motion, render the panorama, write the run folder."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from photonpano.captures.fingerprint import capture_files
from photonpano.captures.order import order_warning
from photonpano.captures.repeats import timeline_of
from photonpano.captures.summary import require_photons
from photonpano.compiling import notify_on_first_compile
from photonpano.context import Context, Progress, Quiet
from photonpano.contributions import MergerContribution
from photonpano.corrections import CorrectedSource, Vignette, divided_by, estimate_vignette
from photonpano.errors import CanvasTooLargeError, InputError, LocationError, OutputError
from photonpano.merging.panorama import RenderedPanorama, render_panorama
from photonpano.motion.frame_motion import motion_of_frames
from photonpano.motion.loop import LevelResult, estimate_motion
from photonpano.motion.timeline import Cut, Timeline
from photonpano.pipeline.checkpoints.fingerprint import run_fingerprint
from photonpano.pipeline.checkpoints.finished import finished_run
from photonpano.pipeline.checkpoints.work_folder import Continuation, work_folder
from photonpano.pipeline.components import build_levels, build_refiners, open_source
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.protocols import Source, Trajectory
from photonpano.record.run_json import peak_memory_bytes, record_of
from photonpano.record.schema import RunRecord
from photonpano.report import loading_figures, render_report
from photonpano.residuals.cuts import find_cuts
from photonpano.residuals.refinement import Explained, Look, refine
from photonpano.residuals.verdict import Verdict, judge
from photonpano.specs.plan import Plan
from photonpano.threads import one_thread_inside, thread_count

logger = logging.getLogger(__name__)

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(frozen=True, slots=True)
class RunResult:
    """A finished run.

    Attributes:
        directory: the run folder.
        record: the content of its `run.json`.
        verdict: whether motion and panorama explain the photons.
        was_finished: whether `resume` found that nothing was left to do.
    """

    directory: Path
    record: RunRecord
    verdict: Verdict
    was_finished: bool = False


def run(
    plan: Plan,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    from_level: int | None = None,
    keep_work: bool = False,
) -> RunResult:
    """Run a plan and write its run folder: panorama, coverage, trajectory, record and report.

    Args:
        plan: from `load_spec` or `parse_spec`.
        progress: receives stages and messages; quiet by default.
        overwrite: whether the run folder may hold files that no run has written, which stay, or a run of another capture.
        resume: go on with a run of the same spec, capture and versions that was interrupted. If it was finished, its results
            are returned.
        from_level: take the levels before this one from the run before, whose work was kept; compute this one and what follows.
            The work is kept again.
        keep_work: keep what each level has found, beside the run folder, for `from_level`.

    Raises:
        InputError: the capture cannot be used, shows nothing, or does not suit the plan.
        LocationError: the motion could not be estimated.
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        PluginError: a component failed in its own way, or broke its contract.
        OutputError: the run folder cannot be written, or another process writes it; it is as it was.
    """
    observers = Observers(plan.observers, plan.output.directory)
    context = Context(thread_count(plan.run.threads), progress or Quiet(), observers.level_finished)
    with (
        observers.watching(plan.document) as finished,
        open_source(plan) as source,
        run_folder(plan.output.directory, overwrite=overwrite, inputs=_read_files(plan)) as folder,
        loading_figures(),
        one_thread_inside(),
        notify_on_first_compile(partial(context.progress.note, COMPILING)),
        ExitStack() as stack,
    ):
        start, memory = time.perf_counter(), int(plan.run.memory)
        _require_photons(plan, source)
        depends_on = run_fingerprint(plan, source)
        if resume and (done := finished_run(plan, depends_on)) is not None:
            finished(done[0])
            return RunResult(plan.output.directory, *done, was_finished=True)
        if warning := order_warning(source):
            logger.warning(warning)
        decisions = [*plan.decisions, *(source.decisions if isinstance(source, CorrectedSource) else ())]
        how = Continuation(resume, from_level, keep_work)
        work = stack.enter_context(work_folder(plan.output.directory, depends_on, decisions, how, context.progress))
        context = replace(context, checkpoints=work.checkpoints)
        reference = _reference_frame(plan, source)
        levels = build_levels(plan, source, decisions)
        timeline = timeline_of(source, context)
        results = estimate_motion(source, levels[:1], plan.graph, reference, context, timeline=timeline)
        known, later = results[0].trajectory, levels[1:]
        if vignette := vignette_of(plan, source, known):
            decisions.append(vignette.decision)
            source, context = divided_by(source, vignette), replace(context, checkpoints=work.checkpoints.within(vignette))
            if not later:
                results, later = [], levels
        results += estimate_motion(source, later, plan.graph, reference, context, plan.until_converged, known, timeline)
        rendering = plan.render.tolerance_px, memory, context
        look = Look(source, motion_of_frames(results, source.info, reference), *rendering)
        if cuts := find_cuts(source, look, context):
            timeline, results, look = _cut_at(cuts, plan, source, context, timeline, results, look)
        decisions += timeline.decisions
        refiners = build_refiners(plan, source, decisions)
        explained = refine(source, look, refiners, *rendering)
        verdict = judge(explained, results, decisions)
        motion = explained.motion
        panorama = render_panorama(
            source, motion.trajectory, motion.span, plan.render, memory, folder.write_tile, context, explained.panorama
        )
        observers.rendered(panorama.canvas, panorama.seconds)
        folder.write_results(panorama, motion)
        seconds = time.perf_counter() - start
        record = folder.commit(
            record_of(plan, source.info, decisions, results, explained, verdict, panorama, seconds, depends_on["capture"])
        )
        work.finish()
        record = _with_report(folder, record, explained, panorama)
        finished(record)
    return RunResult(plan.output.directory, record, verdict)


def vignette_of(plan: Plan, source: Source, trajectory: Trajectory) -> Vignette | None:
    """Measure the vignette of a capture, unless its spec lists corrections, or a merger does not accept corrected sums."""
    mergers = [level.merge.contribution for level in plan.levels]
    accepted = all(isinstance(merger, MergerContribution) and merger.accepts_corrected_sums for merger in mergers)
    if not plan.corrects_itself or source.info.kind != "binary" or not accepted:
        return None
    return estimate_vignette(source, trajectory)


def _read_files(plan: Plan) -> list[Path]:
    return [*capture_files(plan), *([] if plan.file is None else [plan.file])]


def _with_report(folder: RunFolder, record: RunRecord, explained: Explained, panorama: RenderedPanorama) -> RunRecord:
    """Add the report to the run folder. The results are there already: what fails now is a warning."""
    try:
        folder.reopen()
        try:
            folder.write_report(render_report(record, explained, panorama))
        except Exception as error:
            logger.debug("the report failed", exc_info=True)
            warning = f"the report could not be drawn ({type(error).__name__}: {error}); all other files of the run are written"
            record = {**record, "warnings": [*record["warnings"], warning]}
        return folder.commit({**record, "peak_memory_bytes": peak_memory_bytes()})
    except OutputError as error:
        warning = f"the report could not be added ({error}); all other files of the run are written"
        return {**record, "warnings": [*record["warnings"], warning]}


def _cut_at(
    cuts: Sequence[Cut],
    plan: Plan,
    source: Source,
    context: Context,
    timeline: Timeline,
    results: list[LevelResult],
    look: Look,
) -> tuple[Timeline, list[LevelResult], Look]:
    """Estimate the motion again, cut where the image jumps; keep what was known if that explains the photons better.

    All levels run again: with exposures across a jump, the first went astray, too.
    """
    cut, reference = timeline.cut_at(cuts), look.motion.reference
    try:
        levels = build_levels(plan, source, [])
        again = estimate_motion(source, levels, plan.graph, reference, context, plan.until_converged, timeline=cut)
        motion = motion_of_frames(again, source.info, reference)
        seen = Look(source, motion, plan.render.tolerance_px, int(plan.run.memory), context)
        # Frames that show nothing contradict any motion, and the surer it is the more; such a run is doubtful in any case.
        worse = "" if any(each.dark is not None for each in cuts) else seen.worse_than(look)
    except (LocationError, CanvasTooLargeError) as error:
        worse = str(error)
    if worse:
        places = ", ".join(f"frame {each.frame}" for each in cuts)
        logger.warning(f"the image seems to jump before {places}, but the motion is not cut there: {worse}")
        return timeline, results, look
    return cut.cut_at([each.along(motion.trajectory, motion.frame_shape) for each in cuts]), again, seen


def _require_photons(plan: Plan, source: Source) -> None:
    """Refuse a capture that is all dark or all lit, at the place of the spec that names it."""
    try:
        require_photons(source)
    except InputError as error:
        raise InputError(str(plan.place("source").problem(str(error)))) from error


def _reference_frame(plan: Plan, source: Source) -> int:
    n_frames, reference = source.info.n_frames, plan.render.reference
    named = {"first": 0, "middle": n_frames // 2, "last": n_frames - 1}
    return named[reference] if isinstance(reference, str) else reference
