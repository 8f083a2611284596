"""One run: begin, estimate the motion, refine and judge it, render the panorama, and end; or let another kind of run do it."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from importlib.metadata import packages_distributions, version
from pathlib import Path
from typing import Any

import cv2

from photonpano.capture import capture_of
from photonpano.compiling import notify_on_first_compile
from photonpano.contracts.protocols import Source, light_of
from photonpano.corrections.movers import decision_of
from photonpano.errors import CanvasTooLargeError, InputError, LocationError, OutputError, PhotonpanoError, PluginError
from photonpano.evaluation import RunTrajectory, load_panorama, load_run_trajectory
from photonpano.execution.context import Context, Progress, Quiet, TimeLimit, usual
from photonpano.execution.threads import one_thread_inside
from photonpano.files.folders import atomic_path
from photonpano.motion.loop import LevelResult
from photonpano.pipeline.alternatives import beside_alternatives
from photonpano.pipeline.checkpoints.work_folder import Continuation, Work, finished_run, run_fingerprint, work_folder
from photonpano.pipeline.components import open_source
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.executors import on_executor
from photonpano.pipeline.follow import followed
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.obstacles import naming_obstacles, order_warning, run_others
from photonpano.pipeline.passes import build_refiners, refine
from photonpano.pipeline.rendering import render_into, write_halves
from photonpano.pipeline.run_folder import RunFolder, run_folder, write_exposures
from photonpano.pipeline.state import State
from photonpano.pipeline.summary import require_photons
from photonpano.plugins.contributions import RunKindContribution
from photonpano.record.contents import capture_files, fingerprint, frames_sha256, name_of_capture
from photonpano.record.run_json import detail_record, level_record, peak_memory_bytes, record_of, started_record, verdict_of
from photonpano.record.schema import CaptureRecord, RunRecord
from photonpano.report import OpenCapture, render_failure, render_report
from photonpano.report.notebook import ShownReport, run_html
from photonpano.residuals.findings import Findings
from photonpano.residuals.verdict import judge
from photonpano.specs import load_spec, parse_spec
from photonpano.specs.plan import Plan
from photonpano.text import listed
from photonpano.values import Decision, Journal, Panorama, Verdict

END_AFTER_S = 5.0  # default time without a new frame after which a followed capture is complete
logger = logging.getLogger(__name__)

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(frozen=True, slots=True, weakref_slot=True)
class RunResult:
    """A finished run.

    Attributes:
        directory: the run folder.
        record: the content of its `run.json`.
        verdict: whether motion and panorama, or what was found instead, explain the photons.
        was_finished: whether `resume` found that nothing was left to do.
        others: the runs of the other shots of the capture, longer ones first; those that failed are missing.
        kind: that of a run that finds something else than a panorama; None for a panorama.
    """

    directory: Path
    record: RunRecord = field(repr=False)
    verdict: Verdict | None
    was_finished: bool = False
    others: tuple[RunResult, ...] = ()
    kind: RunKindContribution | None = field(default=None, repr=False)

    @property
    def trajectory(self) -> RunTrajectory:
        """The motion of each frame with its expected error, read from the run folder."""
        return load_run_trajectory(self.directory)

    @property
    def panorama(self) -> Panorama:
        """The panorama, read from the run folder: flux, weight and canvas."""
        return Panorama(*load_panorama(self.directory), self.trajectory.canvas)

    @property
    def rows(self) -> Sequence[tuple[str, str]]:
        """What a kind of run shows of its results, with names; nothing for a panorama."""
        return () if self.kind is None else self.kind.runs.rows(self.record)

    def _repr_html_(self) -> str:
        """Show picture, verdict and files in a notebook, and those of other shots."""
        return run_html(self.directory, self.record, self.rows) + "".join(each._repr_html_() for each in self.others)

    def viewer(self, height_px: int = 900) -> ShownReport:
        """Return the report with its viewer, some megabytes, which a notebook shows as the last line of a cell.

        Raises:
            InputError: the run folder has no report.
        """
        return ShownReport(self.directory / "report.html", height_px)


def run(
    plan: Plan | str | Path | Mapping[str, Any],
    progress: Progress | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    from_level: int | None = None,
    keep_work: bool = False,
    follow: bool = False,
    end_after: float = END_AFTER_S,
) -> RunResult:
    """Run a plan and write its run folder: panorama, coverage, trajectory, record and report; or what its `kind` finds.

    Where the capture holds shots that nothing ties together, the longest is run, and then each other one into a folder of its
    own: `runs/scan.panorama-2` beside `runs/scan`, and so on, longer ones first. One that fails is a warning.

    Args:
        plan: from `load_spec` or `parse_spec`; or what these take, the path of a spec, or a spec as plain data.
        progress: receives stages and messages; by default, bars in a notebook and nothing elsewhere.
        overwrite: whether the run folder may hold files that no run has written, which stay, or a run of another capture.
        resume: go on with a run of the same spec, capture and versions that was interrupted. If it was finished, its results
            are returned.
        from_level: take the levels before this one from the run before, whose work was kept; compute this one and what follows.
            The work is kept again. Only a run for a panorama keeps work.
        keep_work: keep what each level has found, beside the run folder, for `from_level`.
        follow: follow a capture that is still being written: run the frames that are there, and write a page with the panorama
            so far to the folder `DIR.live` beside the run folder. Once the capture is complete, it is run as any other.
        end_after: with `follow`, the seconds without a new frame after which a growing file counts as complete.

    Raises:
        InputError: the capture cannot be used or followed, shows nothing, or does not suit the plan.
        LocationError: the motion could not be estimated. `report` of this error and of the next two is a page beside the run
            folder, with the exposures that did not match.
        CanvasTooLargeError: the panorama would exceed the memory of the spec.
        PluginError: a component failed in its own way, or broke its contract.
        OutputError: the run folder cannot be written, or another process writes it; it is as it was.
    """
    if not isinstance(plan, Plan):
        plan = parse_spec(plan) if isinstance(plan, Mapping) else load_spec(plan)
    if follow:
        if resume or from_level is not None:
            raise InputError("a run that follows a capture begins anew: without resume and from_level")
        so_far = partial(run, progress=Quiet(), overwrite=True)
        with followed(plan, so_far, usual(progress), overwrite=overwrite, end_after=end_after) as complete:
            return run(complete, progress, overwrite=overwrite, keep_work=keep_work)
    with begun_run(plan, usual(progress), Continuation(resume, from_level, keep_work), overwrite=overwrite) as begun:
        if not begun.was_finished:
            (make_panorama if plan.kind is None else plan.kind.runs.run)(begun)
    result = RunResult(plan.output.directory, begun.record, begun.verdict, begun.was_finished, kind=plan.kind)
    again = partial(run, progress=progress, overwrite=overwrite, resume=resume, from_level=from_level, keep_work=keep_work)
    return replace(result, others=tuple(run_others(plan, result.record, again, usual(progress))))


def make_panorama(run: BegunRun) -> None:
    """Estimate the motion in levels, refine and judge it, render the panorama, and end the run."""
    plan, folder, journal = run.plan, run.folder, run.journal
    with on_executor(plan, run.source, run.context) as context:
        with naming_obstacles(run.source):
            state = estimate(plan, run.source, journal, context)
        state, explained = refine(state, build_refiners(plan, state.view.source, journal), journal)
        explained, findings = beside_alternatives(state, explained)
        journal += _last_decisions(state, findings)
        source, context = state.view
        panorama, chosen = render_into(folder, plan, source, vignette=state.vignette, motion=explained.motion, context=context)
        findings = replace(findings, never_seen_share=panorama.never_seen_share)
        verdict = judge(explained, state.results, findings)
        run.observers.rendered(panorama.canvas, panorama.seconds)
        if plan.output.keep == "exposures":
            with folder.writing():
                write_exposures(folder.staging, state.results, panorama.white_flux, context)
        detail = explained.halves.detail
        if plan.output.keep == "halves":
            detail = write_halves(folder, plan, source, motion=explained.motion, canvas=panorama.canvas, context=context)
    record = record_of(
        run.started_record(),
        plan,
        state.results,
        explained=explained,
        verdict=verdict,
        panorama=panorama,
        rendered=chosen,
        findings=findings,
    )
    record["detail"] = detail_record(detail)
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


@dataclass(eq=False, kw_only=True)
class BegunRun:
    """A run that has begun."""

    plan: Plan
    source: Source
    folder: RunFolder
    observers: Observers
    progress: Progress
    start: float  # when the capture was open, in seconds of `time.perf_counter`
    journal: Journal = field(default_factory=list)  # the decisions so far, in the order in which they were taken
    # the levels so far; one that was located again is there more than once
    levels: list[LevelResult] = field(default_factory=list)
    work: Work | None = None
    was_finished: bool = False  # whether the run was finished before, so that nothing is left to do
    record: RunRecord = field(init=False)  # of the finished run
    verdict: Verdict | None = None  # whether the results explain the photons

    @cached_property
    def capture(self) -> CaptureRecord:
        """The fingerprint of the capture."""
        return fingerprint(self.plan, self.source)

    def require_unchanged(self) -> None:
        """Raise `InputError` if frames of the capture are others than when the run began."""
        if frames_sha256(self.source) != self.capture["frames_sha256"]:
            name = name_of_capture(self.plan)
            raise InputError(f"{name} was changed while it was read; run it again as soon as nothing writes to it")

    @property
    def context(self) -> Context:
        """How the run computes: with its progress, its checkpoints, and observers of levels."""

        def on_level(result: LevelResult) -> None:
            self.levels.append(result)
            self.observers.level_finished(result)

        limit = TimeLimit(self.start + (self.plan.run.time_limit or math.inf))
        context = Context(progress=self.progress, on_level=on_level, time_limit=limit)
        return context if self.work is None else replace(context, checkpoints=self.work.checkpoints)

    def started_record(self) -> RunRecord:
        """Return the record of the run, without its results."""
        return started_record(self.plan, self.source.info, self.journal, time.perf_counter() - self.start, self.capture)

    def end(self, record: RunRecord, draw: Callable[[RunRecord], str], verdict: Verdict | None = None) -> None:
        """Put the files of the run into its folder, and then the report that `draw` makes of the record."""
        self.require_unchanged()
        record = self.folder.commit(record)
        if self.work is not None:
            self.work.finish()
        self.record, self.verdict = _with_report(self.folder, record, draw), verdict


@contextmanager
def begun_run(plan: Plan, progress: Progress, how: Continuation, *, overwrite: bool) -> Iterator[BegunRun]:
    """Begin a run: tell the observers, open the capture, lock the run folder, and go on with what was kept.

    The block ends the run, unless it was finished before. If the block fails, a report of that lies beside the run folder,
    which stays as it was.
    """
    if plan.kind is not None and (how.keep or how.from_level is not None):
        no_levels = f"a run with `{plan.kind.section}` has no levels to keep or to go on from"
        raise InputError(f"{no_levels}: leave out --keep-work and --from-level")
    _require_opencv()
    observers, read = Observers(plan.observers, plan.output.directory), [*capture_files(plan), *filter(None, [plan.file])]
    with (
        observers.watching(plan.document) as finished,
        notify_on_first_compile(partial(progress.note, COMPILING)),
        open_source(plan) as source,
        run_folder(plan.output.directory, overwrite=overwrite, inputs=read) as folder,
        one_thread_inside(),
    ):
        run = BegunRun(
            plan=plan, source=source, folder=folder, observers=observers, progress=progress, start=time.perf_counter()
        )
        _require_photons(plan, source)
        if how.resume and (done := finished_run(plan, run.capture)) is not None:
            run.record, run.was_finished = done, True
            run.verdict = None if done["verdict"] is None else verdict_of(done["verdict"])
            yield run
        else:
            if warning := order_warning(source):
                logger.warning(warning)
            run.journal += [*filter(None, [plan.recognised]), *source.decisions]
            with _work(run, how) as run.work, _reporting_failure(run):
                yield run
        finished(run.record)


def _require_opencv() -> None:
    """Refuse another OpenCV than the required one: of two distributions, that which was installed last is imported."""
    name = "opencv-python-headless"
    if not version(name).startswith(cv2.__version__):
        others = sorted({*packages_distributions()["cv2"]} - {name})
        remove = f"`pip uninstall {' '.join([*others, name])}` and then `pip install {name}`"
        of = f" of {listed(others)}" if others else ""
        raise InputError(f"OpenCV {cv2.__version__}{of} is imported instead of {name} {version(name)}: run {remove}")


def _work(run: BegunRun, how: Continuation) -> AbstractContextManager[Work | None]:
    """Open the work folder of a run; one that finds something else than a panorama does it in one step, and keeps nothing."""
    plan = run.plan
    if plan.kind is not None:
        if how.resume:
            run.progress.note(f"a run with `{plan.kind.section}` keeps no work: it begins anew")
        return nullcontext()
    depends_on = run_fingerprint(plan, run.capture, run.source.info.frame_shape)
    return work_folder(plan.output.directory, depends_on, how, run.progress)


@contextmanager
def _reporting_failure(run: BegunRun) -> Iterator[None]:
    """Write a report if the block raises; its path is the `report` of the error. That of the run before is removed first.

    It is `runs/scan.failed.html` for the run folder `runs/scan`.
    """
    path = run.folder.directory.with_name(f"{run.folder.directory.name}.failed.html")
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        logger.debug("the report of an earlier failure could not be removed: %s", error)
    try:
        yield
    except KeyboardInterrupt as error:
        if run.work is not None:
            error.add_note("the same command with --resume goes on")
        raise
    except (LocationError, CanvasTooLargeError, PluginError) as error:
        run.require_unchanged()
        levels = {result.level.number: level_record(result) for result in run.levels}
        record = run.started_record() | {"status": "failed", "levels": [levels[number] for number in sorted(levels)]}
        error.report = _written_failure(path, record, error)
        raise


def _written_failure(path: Path, record: RunRecord, error: PhotonpanoError) -> Path | None:
    """Write the report of a failure; return None if that fails, too: the error of the run is what counts."""
    try:
        page = render_failure(record, error)
        with atomic_path(path) as temporary:
            temporary.write_text(page, encoding="utf-8")
    except Exception:
        logger.debug("the report of the failure could not be written", exc_info=True)
        return None
    return path


def _with_report(folder: RunFolder, record: RunRecord, draw: Callable[[RunRecord], str]) -> RunRecord:
    """Add the report to the run folder. The results are there already: what fails now is a warning."""
    try:
        try:
            folder.add_report(draw(record))
        except Exception as error:
            logger.debug("the report failed", exc_info=True)
            warning = f"the report could not be drawn ({type(error).__name__}: {error}); all other files of the run are written"
            record = {**record, "warnings": [*record["warnings"], warning]}
        return folder.update({**record, "peak_memory_bytes": peak_memory_bytes()})
    except OutputError as error:
        warning = f"the report could not be added ({error}); all other files of the run are written"
        return {**record, "warnings": [*record["warnings"], warning]}


def _require_photons(plan: Plan, source: Source) -> None:
    """Refuse a capture that is all dark or all lit, at the place of the spec that names it."""
    try:
        require_photons(source)
    except InputError as error:
        raise plan.error("source", str(error)) from error
