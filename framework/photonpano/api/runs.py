"""Score runs, and prepare this machine for them."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from photonpano.api.captures import simulate
from photonpano.api.opened_run import opened_run
from photonpano.context import Context, Progress, usual
from photonpano.evaluation import Evaluation
from photonpano.evaluation import evaluate as evaluate_folder
from photonpano.geometry import Canvas
from photonpano.merging.colour import composed
from photonpano.merging.panorama import render
from photonpano.pipeline.components import build_renderer
from photonpano.pipeline.run import run
from photonpano.protocols import Trajectory
from photonpano.registry import Catalog
from photonpano.specs import parse_spec
from photonpano.threads import thread_count
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
        run_folder: written by `run`.
        truth: the `.truth.npz` that was simulated with the capture.
        oracle: also render the capture along the true motion, and score that; opens the capture again.
        progress: receives the stages of that; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: a file is missing or damaged, or run and truth are not of the same capture.
    """
    if not oracle:
        return evaluate_folder(run_folder, truth)
    with opened_run(Path(run_folder), catalog) as opened:

        def along_truth(trajectory: Trajectory, canvas: Canvas) -> Panorama:
            source, plan = opened.source, opened.plan
            context = Context(thread_count(plan.run.threads), usual(progress))
            renderer = build_renderer(plan, source, [])
            images = render(source, trajectory, source.info.span, canvas, plan.render.tolerance_px, context, renderer)
            return composed(images, source)

        return evaluate_folder(run_folder, truth, along_truth)


def warm_up() -> float:
    """Compile the loops over pixels for this machine, by a run on a small simulated capture.

    Otherwise the first run compiles them. The result is kept beside the installed package, or in the home folder where that
    cannot be written, until the package or the machine changes.

    Returns:
        How long it took, in seconds.
    """
    start = time.perf_counter()
    simulator = {"n_frames": 240, "frame_shape": [96, 128], "path": {"kind": "pan", "length_px": 40}}
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture.npy"
        simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}}), capture)
        spec = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(capture)}},
            "resample": {"with": {"group_size": 40}},
            "levels": [{"scale": 0.5}, {}],
        }
        run(parse_spec(spec, output=Path(folder) / "run"))
    return time.perf_counter() - start
