"""Score a run against the truth of its capture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import typer

from photonpano.api.command import command, json_lines, warn
from photonpano.api.opened_run import opened_run
from photonpano.contracts.protocols import Trajectory
from photonpano.evaluation import Evaluation, ImageScore, PoseScore, RotationScore, evaluate_poses, has_poses
from photonpano.evaluation import evaluate as evaluate_folder
from photonpano.execution.context import Context, Progress, usual
from photonpano.execution.threads import thread_count
from photonpano.geometry import Canvas
from photonpano.merging.colour import composed
from photonpano.merging.panorama import render
from photonpano.pipeline.rendering import build_renderer
from photonpano.plugins.registry import Catalog
from photonpano.text import columns
from photonpano.values import Panorama

_FEW = 0.1  # if fewer positions lie within 3 expected errors, the truth is probably of another capture


def _score(run_folder: Path, truth: Path, **how: Any) -> Evaluation | PoseScore:
    """Score a panorama or poses, whichever the run has found."""
    if not has_poses(run_folder):
        return evaluate(run_folder, truth, **how)
    score = evaluate_poses(run_folder, truth)
    if score.honest_shares is not None and score.honest_shares[2] < _FEW:
        warn(f"{100 * score.honest_shares[2]:.0f} % of the positions are within 3 std_position: is {truth} of this capture?")
    return score


def _lines(score: Evaluation | PoseScore, *, as_json: bool = False) -> Iterator[str]:
    if not as_json:
        yield columns(score.rows())
    elif isinstance(score, Evaluation):
        yield from json_lines(_data(score))
    else:
        named = {each.name: each.name for each in fields(score)} | {"honest_shares": "within_std_shares"}
        yield from json_lines({named[name]: getattr(score, name) for name in named if name not in ("errors_m", "errors_deg")})


@command(
    "runs/scan --truth cube.truth.npz",
    _lines,
    calls=_score,
    truth=typer.Option(metavar="TRUTH.npz"),
    oracle=typer.Option("--oracle/--no-oracle"),
)
def evaluate(
    run_folder: Path | str,
    truth: Path | str,
    oracle: bool = True,
    progress: Progress | None = None,
    catalog: Catalog | None = None,
    *,
    capture: Path | str | None = None,
) -> Evaluation:
    """Score a run folder against the truth of its capture.

    Corner errors are in px of a frame, over the located frames, after the best alignment of both reference planes. Those of
    rotations are angles, after the best common rotation. PSNR and SSIM compare the panorama with the true scene, where it was
    seen. The oracle is the panorama along the true motion.

    Of a run with `pose`, positions are in m after the best similarity (ATE), and relative errors (RPE) over some frames.

    Args:
        run_folder: written by `run`.
        truth: the `.truth.npz` that was simulated with the capture.
        oracle: also render the capture along the true motion, and score that; opens the capture again.
        progress: receives the stages of that; by default, bars in a notebook and nothing elsewhere.
        catalog: what can be chosen; by default what the installed plugins offer.
        capture: the capture, if it is not where the run has read it: a file, a folder, or a URL.

    Raises:
        InputError: a file is missing or damaged, or run and truth are not of the same capture.
    """
    if not oracle:
        return evaluate_folder(run_folder, truth)
    with opened_run(Path(run_folder), catalog, moved=capture) as opened:

        def along_truth(trajectory: Trajectory, canvas: Canvas) -> Panorama:
            source, plan = opened.source, opened.plan
            context = Context(thread_count(plan.run.threads), usual(progress))
            renderer = build_renderer(plan, source, [])
            images = render(source, trajectory, source.info.span, canvas, plan.render.tolerance_px, context, renderer)
            return composed(images, source)

        return evaluate_folder(run_folder, truth, along_truth)


def _data(evaluation: Evaluation) -> dict[str, Any]:
    motion = evaluation.trajectory
    return {
        "corner_error_px": {name: getattr(motion, f"{name}_px") for name in ("mean", "median", "p95", "max")},
        "located_share": motion.located_share,
        "within_three_std_share": evaluation.honest_share,
        "rotation": _given(evaluation.rotation, "mean_deg", "max_deg", "focal_error", "focal_std"),
        "panorama": _given(evaluation.panorama, "psnr_db", "ssim", "compared_share"),
        "oracle": _given(evaluation.oracle, "psnr_db", "ssim", "compared_share"),
        "below_oracle_db": evaluation.below_oracle_db,
    }


def _given(score: ImageScore | RotationScore | None, *names: str) -> dict[str, float | None] | None:
    return None if score is None else {name: getattr(score, name) for name in names}
