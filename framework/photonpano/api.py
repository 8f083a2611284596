"""The same as the command line, for notebooks and scripts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from photonpano.context import Progress
    from photonpano.evaluation import Evaluation
    from photonpano.geometry import Canvas
    from photonpano.protocols import Trajectory
    from photonpano.registry import Catalog
    from photonpano.specs import Plan
    from photonpano.values import Panorama


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
    from photonpano.pipeline.components import open_source
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
    from photonpano.record.run_json import read_record
    from photonpano.specs import parse_spec

    return parse_spec(read_record(run_folder)["spec"], name=str(run_folder / "run.json"), catalog=catalog)
