"""One run: begin, estimate the motion, refine and judge it, render the panorama, and end; or find the poses instead."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from photonpano.capture import capture_of
from photonpano.contracts.protocols import light_of
from photonpano.corrections.movers import decision_of
from photonpano.errors import InputError
from photonpano.execution.context import Progress, Quiet, usual
from photonpano.pipeline.alternatives import beside_alternatives
from photonpano.pipeline.checkpoints.work_folder import Continuation
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.executors import executor_of
from photonpano.pipeline.follow import followed
from photonpano.pipeline.obstacles import naming_obstacles, run_others
from photonpano.pipeline.passes import build_refiners, refine
from photonpano.pipeline.pose_run import find_poses
from photonpano.pipeline.rendering import render_into
from photonpano.pipeline.run_folder import write_exposures
from photonpano.pipeline.run_steps import BegunRun, begun_run
from photonpano.pipeline.state import State
from photonpano.record.run_json import record_of
from photonpano.record.schema import RunRecord
from photonpano.report import OpenCapture, render_report
from photonpano.report.notebook import ShownReport, run_html
from photonpano.residuals.findings import Findings
from photonpano.residuals.verdict import judge
from photonpano.specs.plan import Plan
from photonpano.text import listed
from photonpano.values import Decision, Verdict

END_AFTER_S = 5.0  # default time without a new frame after which a followed capture is complete


@dataclass(frozen=True, slots=True)
class RunResult:
    """A finished run.

    Attributes:
        directory: the run folder.
        record: the content of its `run.json`.
        verdict: whether motion and panorama, or the poses, explain the photons.
        was_finished: whether `resume` found that nothing was left to do.
        others: the runs of the other shots of the capture, longer ones first; those that failed are missing.
    """

    directory: Path
    record: RunRecord = field(repr=False)
    verdict: Verdict | None
    was_finished: bool = False
    others: tuple[RunResult, ...] = ()

    def _repr_html_(self) -> str:
        """Show picture, verdict and files in a notebook, and those of other shots."""
        return run_html(self.directory, self.record) + "".join(each._repr_html_() for each in self.others)

    def viewer(self, height_px: int = 900) -> ShownReport:
        """Return the report with its viewer, some megabytes, which a notebook shows as the last line of a cell.

        Raises:
            InputError: the run folder has no report.
        """
        return ShownReport(self.directory / "report.html", height_px)


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

    Where the capture holds shots that nothing ties together, the longest is run, and then each other one into a folder of its
    own: `runs/scan.panorama-2` beside `runs/scan`, and so on, longer ones first. One that fails is a warning.

    Args:
        plan: from `load_spec` or `parse_spec`.
        progress: receives stages and messages; by default, bars in a notebook and nothing elsewhere.
        overwrite: whether the run folder may hold files that no run has written, which stay, or a run of another capture.
        resume: go on with a run of the same spec, capture and versions that was interrupted. If it was finished, its results
            are returned.
        from_level: take the levels before this one from the run before, whose work was kept; compute this one and what follows.
            The work is kept again. A run of poses keeps no work.
        keep_work: keep what each level has found, beside the run folder, for `from_level`.
        follow: follow a capture that is still being written: run the frames that are there, and write a page with the panorama
            so far to the folder `DIR.live` beside the run folder. Once the capture is complete, it is run as any other.
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
        so_far = partial(run, progress=Quiet(), overwrite=True)
        with followed(plan, so_far, usual(progress), overwrite=overwrite, end_after=end_after) as complete:
            return run(complete, progress, overwrite=overwrite, keep_work=keep_work)
    with begun_run(plan, usual(progress), Continuation(resume, from_level, keep_work), overwrite=overwrite) as begun:
        if not begun.was_finished:
            (make_panorama if plan.pose is None else find_poses)(begun)
    result = RunResult(plan.output.directory, begun.record, begun.verdict, begun.was_finished)
    again = partial(run, progress=progress, overwrite=overwrite, resume=resume, from_level=from_level, keep_work=keep_work)
    return replace(result, others=tuple(run_others(plan, result.record, again, usual(progress))))


def make_panorama(run: BegunRun) -> None:
    """Estimate the motion in levels, refine and judge it, render the panorama, and end the run."""
    plan, folder, journal = run.plan, run.folder, run.journal
    with executor_of(plan, run.source) as executor:
        context = replace(run.context, threads=executor.under_way, executor=executor)
        with naming_obstacles(run.source):
            state = estimate(plan, run.source, journal, context)
        state, explained = refine(state, build_refiners(plan, state.view.source, journal), journal)
        explained, findings = beside_alternatives(state, explained)
        journal += _last_decisions(state, findings)
        source, context = state.view
        panorama, chosen = render_into(folder, plan, source, state.vignette, explained.motion, context)
        findings = replace(findings, never_seen_share=panorama.never_seen_share)
        verdict = judge(explained, state.results, findings)
        run.observers.rendered(panorama.canvas, panorama.seconds)
        if plan.output.keep == "exposures":
            with folder.writing():
                write_exposures(folder.staging, state.results, panorama.white_flux, context)
    record = record_of(run.started_record(), plan, state.results, explained, verdict, panorama, chosen, findings)
    light, capture = light_of(source), OpenCapture(source, state.results)
    run.end(record, lambda record: render_report(record, explained, panorama, light, capture), verdict)


def _last_decisions(state: State, findings: Findings) -> Iterator[Decision]:
    """Yield the decisions on what is left out, and on a rival motion."""
    if findings.left_out:
        over = f"left out, since {state.plan.run.time_limit:g} s were over"
        yield Decision("time_limit", listed(findings.left_out), over)
    if (background := capture_of(state.source).background) is not None:
        yield decision_of(background)
    if (rival := findings.rival_motion) is not None:
        yield Decision("rival_motion", rival.px, rival.where)
