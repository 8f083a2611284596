"""One run: open the capture, estimate the motion, render the panorama, write the run folder."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

from photonpano.captures.obstacles import naming_obstacles
from photonpano.context import Context, Progress, usual
from photonpano.errors import InputError
from photonpano.motion.loop import LevelResult
from photonpano.pipeline.checkpoints.fingerprint import run_fingerprint
from photonpano.pipeline.checkpoints.finished import finished_run
from photonpano.pipeline.checkpoints.work_folder import Continuation, work_folder
from photonpano.pipeline.components import build_refiners
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.executors import executor_of
from photonpano.pipeline.failed_run import reporting_failure
from photonpano.pipeline.following.follow import followed
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.pose_run import run_poses
from photonpano.pipeline.rendering import render_into
from photonpano.pipeline.run_steps import begun_run, first_decisions, with_report
from photonpano.protocols import light_of
from photonpano.record.run_json import record_of, verdict_of
from photonpano.record.schema import RunRecord
from photonpano.report import LiveFigures, OpenCapture, render_report
from photonpano.report.notebook import run_html
from photonpano.residuals.refinement import refine
from photonpano.residuals.verdict import Verdict, judge
from photonpano.specs.plan import Plan

END_AFTER_S = 5.0
"""Seconds without a new frame after which a capture that is followed is complete, by default."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """A finished run.

    Attributes:
        directory: the run folder.
        record: the content of its `run.json`.
        verdict: whether motion and panorama explain the photons; None for poses, whose doubts are in the record.
        was_finished: whether `resume` found that nothing was left to do.
        followed: how fast the frames of a capture were located that was followed.
    """

    directory: Path
    record: RunRecord = field(repr=False)
    verdict: Verdict | None
    was_finished: bool = False
    followed: LiveFigures | None = None

    def _repr_html_(self) -> str:
        """Show picture, verdict and files in a notebook."""
        return run_html(self.directory, self.record)


def run(
    plan: Plan,
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    from_level: int | None = None,
    keep_work: bool = False,
    follow: bool = False,
    end_after: float = END_AFTER_S,
) -> RunResult:
    """Run a plan and write its run folder: panorama, coverage, trajectory, record and report; or poses, for a plan with `pose`.

    Args:
        plan: from `load_spec` or `parse_spec`.
        progress: receives stages and messages; by default, bars in a notebook and nothing elsewhere.
        overwrite: whether the run folder may hold files that no run has written, which stay, or a run of another capture.
        resume: go on with a run of the same spec, capture and versions that was interrupted. If it was finished, its results
            are returned.
        from_level: take the levels before this one from the run before, whose work was kept; compute this one and what follows.
            The work is kept again. A run of poses keeps no work.
        keep_work: keep what each level has found, beside the run folder, for `from_level`.
        follow: follow a capture that is still being written: locate its frames as they arrive, and write a page with the
            picture so far to the folder `DIR.live` beside the run folder. Once the capture is complete, it is run as any other.
        end_after: with `follow`, the seconds without a new frame after which a growing file counts as complete.

    Raises:
        InputError: the capture cannot be used or followed, shows nothing, or does not suit the plan.
        LocationError: the motion could not be estimated; `report` is a page with the exposures that did not match, beside the
            run folder. So it is for the next two.
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        PluginError: a component failed in its own way, or broke its contract.
        OutputError: the run folder cannot be written, or another process writes it; it is as it was.
    """
    if follow:
        if resume or from_level is not None:
            raise InputError("a run that follows a capture begins anew: without resume and from_level")
        with followed(plan, usual(progress), overwrite=overwrite, end_after=end_after) as complete:
            result = run(complete.plan, progress, overwrite=overwrite, keep_work=keep_work)
            return replace(result, followed=complete.figures)
    if plan.pose is not None:
        keeps_work = keep_work or from_level is not None
        poses, was_finished = run_poses(plan, progress, overwrite=overwrite, resume=resume, keeps_work=keeps_work)
        return RunResult(plan.output.directory, poses, None, was_finished)
    return _panorama(plan, usual(progress), Continuation(resume, from_level, keep_work), overwrite=overwrite)


def _panorama(plan: Plan, progress: Progress, how: Continuation, *, overwrite: bool) -> RunResult:
    """Run a plan for a panorama: estimate the motion in levels, refine and judge it, render, and write the results."""
    observers = Observers(plan.observers, plan.output.directory)
    finished: list[LevelResult] = []

    def on_level(result: LevelResult) -> None:
        finished.append(result)
        observers.level_finished(result)

    context = Context(progress=progress, on_level=on_level)
    with begun_run(plan, observers, progress, overwrite=overwrite) as begun, ExitStack() as stack:
        source, folder, memory = begun.source, begun.folder, int(plan.run.memory)
        depends_on = run_fingerprint(plan, source)
        if how.resume and (done := finished_run(plan, depends_on["capture"])) is not None:
            assert done["verdict"] is not None
            begun.finished(done)
            return RunResult(plan.output.directory, done, verdict_of(done["verdict"]), was_finished=True)
        decisions = first_decisions(plan, source)
        work = stack.enter_context(work_folder(plan.output.directory, depends_on, decisions, how, progress))
        stack.enter_context(reporting_failure(plan, begun, decisions, finished, depends_on["capture"]))
        executor = stack.enter_context(executor_of(plan, source))
        context = replace(context, threads=executor.under_way, checkpoints=work.checkpoints, executor=executor)
        with naming_obstacles(source, decisions):
            found = estimate(plan, source, decisions, context)
        source, context = found.source, found.context
        refiners = build_refiners(plan, source, decisions)
        explained = refine(source, found.look, refiners, plan.render.tolerance_px, memory, context)
        verdict = judge(explained, found.results, decisions)
        motion = explained.motion
        rendering = render_into(folder, plan, source, found.vignette, motion, context, (explained.canvas, explained.panorama))
        panorama, rendered = rendering.panorama, rendering.decisions
        observers.rendered(panorama.canvas, panorama.seconds)
        if plan.output.keep == "exposures":
            folder.write_exposures(found.results, panorama.white_flux, context)
        record = folder.commit(
            record_of(
                *(plan, source.info, decisions, found.results, explained, verdict, panorama, rendered, begun.seconds),
                depends_on["capture"],
            )
        )
        work.finish()
        light = light_of(source)
        capture = OpenCapture(source, found.results)
        record = with_report(folder, record, lambda record: render_report(record, explained, panorama, light, capture))
        begun.finished(record)
    return RunResult(plan.output.directory, record, verdict)
