"""Begin a run, and end it: observers, capture, run folder, work that is kept, and the report, also of a run that fails."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path

from photonpano.compiling import notify_on_first_compile
from photonpano.contracts.protocols import Source
from photonpano.errors import CanvasTooLargeError, InputError, LocationError, OutputError, PhotonpanoError, PluginError
from photonpano.execution.context import Context, Progress, TimeLimit
from photonpano.execution.threads import one_thread_inside
from photonpano.files.atomic import atomic_path
from photonpano.motion.loop import LevelResult
from photonpano.pipeline.checkpoints.work_folder import Continuation, Work, finished_run, run_fingerprint, work_folder
from photonpano.pipeline.components import open_source
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.obstacles import order_warning
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.pipeline.summary import require_photons
from photonpano.record.contents import capture_files, fingerprint
from photonpano.record.run_json import level_record, peak_memory_bytes, started_record, verdict_of
from photonpano.record.schema import CaptureRecord, RunRecord
from photonpano.report import render_failure
from photonpano.specs.plan import Plan
from photonpano.values import Journal, Verdict

logger = logging.getLogger(__name__)

COMPILING = "compiling for this machine, once; `photonpano warm-up` does it beforehand"


@dataclass(eq=False)
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
    if plan.pose is not None and (how.keep or how.from_level is not None):
        raise InputError("a run with `pose` has no levels to keep or to go on from: leave out --keep-work and --from-level")
    observers, read = Observers(plan.observers, plan.output.directory), [*capture_files(plan), *filter(None, [plan.file])]
    with (
        observers.watching(plan.document) as finished,
        notify_on_first_compile(partial(progress.note, COMPILING)),
        open_source(plan) as source,
        run_folder(plan.output.directory, overwrite=overwrite, inputs=read) as folder,
        one_thread_inside(),
    ):
        run = BegunRun(plan, source, folder, observers, progress, time.perf_counter())
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


def failure_path(directory: Path) -> Path:
    """Return where the report of a failed run lies: `runs/scan.failed.html` for `runs/scan`."""
    return directory.with_name(f"{directory.name}.failed.html")


def _work(run: BegunRun, how: Continuation) -> AbstractContextManager[Work | None]:
    """Open the work folder of a run; poses are found in one step, of which nothing is kept."""
    plan = run.plan
    if plan.pose is not None:
        if how.resume:
            run.progress.note("a run with `pose` keeps no work: it begins anew")
        return nullcontext()
    depends_on = run_fingerprint(plan, run.capture, run.source.info.frame_shape)
    return work_folder(plan.output.directory, depends_on, how, run.progress)


@contextmanager
def _reporting_failure(run: BegunRun) -> Iterator[None]:
    """Write a report if the block raises; its path is the `report` of the error. That of the run before is removed first."""
    path = failure_path(run.folder.directory)
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        logger.debug("the report of an earlier failure could not be removed: %s", error)
    try:
        yield
    except (LocationError, CanvasTooLargeError, PluginError) as error:
        levels = {result.level.number: level_record(result) for result in run.levels}
        record: RunRecord = {
            **run.started_record(),
            "status": "failed",
            "levels": [levels[number] for number in sorted(levels)],
        }
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
