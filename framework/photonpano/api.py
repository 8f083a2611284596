"""The same as the command line, for notebooks and scripts."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from photonpano.errors import InputError, SpecError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano.context import Progress
    from photonpano.evaluation import Evaluation
    from photonpano.geometry import Canvas
    from photonpano.pipeline.observers import Observers
    from photonpano.protocols import Source, Trajectory
    from photonpano.registry import Catalog
    from photonpano.report import RunRecord
    from photonpano.specs import Plan
    from photonpano.values import Panorama


@dataclass(frozen=True, slots=True)
class RunResult:
    """What a run left behind.

    Attributes:
        directory: the run folder.
        record: the content of its `run.json`.
    """

    directory: Path
    record: RunRecord


@contextmanager
def open_source(plan: Plan) -> Iterator[Source]:
    """Open the capture of a plan, and check the stages against what it is.

    Raises:
        InputError: the capture cannot be used as it is.
        SpecError: a stage does not suit it.
    """
    from photonpano.pipeline.components import build_source
    from photonpano.specs import check_stream

    with build_source(plan) as source:
        if problems := check_stream(plan, source.info):
            raise SpecError(problems)
        yield source


def run(plan: Plan, progress: Progress | None = None) -> RunResult:
    """Run a plan and write its run folder: panorama, coverage, trajectory, record and report.

    Args:
        plan: from `load_spec` or `parse_spec`.
        progress: is told of stages; quiet by default.

    Raises:
        PhotonpanoError: the run failed; the message says why, and what was in the run folder before is still there.
    """
    from photonpano.context import Quiet
    from photonpano.pipeline.observers import Observers

    observers = Observers(plan.observers, plan.output.directory)
    with observers.run(plan.document):
        record = _run(plan, progress or Quiet(), observers)
    observers.run_finished(record)
    return RunResult(plan.output.directory, cast("RunRecord", record))


def _run(plan: Plan, progress: Progress, observers: Observers) -> dict[str, Any]:
    """Run a plan, write its run folder, and return the content of `run.json`."""
    from photonpano import __version__
    from photonpano.pipeline.run import execute, write_outcome
    from photonpano.pipeline.run_folder import run_folder
    from photonpano.report import RunArrays, load_figures, render_report

    with open_source(plan) as source, run_folder(plan.output.directory) as folder, ThreadPoolExecutor(1) as aside:
        # A second of imports that nothing waits for.
        aside.submit(load_figures)
        outcome = execute(plan, source, __version__, progress, observers, folder.write_tile)
        write_outcome(folder, outcome, source.info.frame_shape)
        arrays = RunArrays(
            preview=outcome.picture,
            coverage=outcome.panorama.weight,
            homographies=outcome.homographies,
            located=outcome.located,
            std_px=outcome.std_px,
            canvas=outcome.panorama.canvas,
            frame_shape=source.info.frame_shape,
            reference=outcome.reference,
        )
        folder.write_report(render_report(cast("RunRecord", outcome.record), arrays))
    return outcome.record


def evaluate(
    run_folder: Path | str,
    truth: Path | str,
    oracle: bool = True,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
) -> Evaluation:
    """Score a run folder against the truth of its capture.

    Args:
        run_folder: what `run` wrote.
        truth: the `.truth.npz` that was simulated with the capture.
        oracle: also render the capture along the true motion, and score that; opens the capture again.
        progress: is told of the rendering; quiet by default.
        catalog: where components come from; by default what is installed.

    Raises:
        InputError: a file is missing or damaged, or run and truth are not of the same capture.
    """
    from photonpano.context import Context, Quiet
    from photonpano.evaluation import evaluate as evaluate_folder
    from photonpano.merging.panorama import render
    from photonpano.threads import thread_count

    if not oracle:
        return evaluate_folder(run_folder, truth)
    plan = _recorded_plan(Path(run_folder), catalog)
    with open_source(plan) as source:

        def along_truth(trajectory: Trajectory, canvas: Canvas) -> Panorama:
            context = Context(thread_count(plan.run.threads), progress or Quiet())
            return render(source, trajectory, source.info.span, canvas, plan.render.tolerance_px, context)

        return evaluate_folder(run_folder, truth, along_truth)


def _recorded_plan(run_folder: Path, catalog: Catalog | None) -> Plan:
    """Return the plan that a run folder was made with."""
    import json

    from photonpano.specs import parse_spec

    file = run_folder / "run.json"
    if not file.is_file():
        raise InputError(f"{run_folder} has no run.json, so no run finished in it; give the run folder of one that did")
    try:
        document = json.loads(file.read_text(encoding="utf-8"))["spec"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{file}: cannot be read as the record of a run ({error}); give the folder of a finished run"
        ) from error
    return parse_spec(document, name=str(file), catalog=catalog)
