"""photonpano evaluate."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from photonpano.cli.options import Json

if TYPE_CHECKING:
    from photonpano.evaluation import Evaluation, ImageScore, PoseScore

_FEW = 0.1
"""Share of positions within 3 expected errors below which poses and truth hardly belong together."""


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder.", show_default=False)],
    truth: Annotated[
        Path, typer.Option(metavar="TRUTH.npz", help="The truth that 'simulate' wrote beside the capture.", show_default=False)
    ],
    oracle: Annotated[
        bool,
        typer.Option("--oracle/--no-oracle", help="Also render along the true motion; needs the capture, and more time."),
    ] = True,
    as_json: Json = False,
) -> None:
    """Score a run against the truth of its capture.

    Corner errors are in pixels of a frame, over the located frames, after the best alignment of both reference planes. Those
    of rotations are angles, after the best common rotation. PSNR and SSIM compare the panorama with the true scene, where it
    was seen. The oracle is the panorama along the true motion.

    Of a run with 'pose', positions are in m after the best similarity (ATE), and relative errors (RPE) over some frames.

    Example: photonpano evaluate runs/scan --truth cube.truth.npz
    """
    import json

    from photonpano.api.runs import evaluate as evaluate_run
    from photonpano.cli.errors import warn
    from photonpano.cli.progress import progress_for_stderr
    from photonpano.cli.tables import columns
    from photonpano.evaluation import evaluate_poses, has_poses

    if has_poses(run):
        score = evaluate_poses(run, truth)
        if score.honest_shares is not None and score.honest_shares[2] < _FEW:
            warn(
                f"{100 * score.honest_shares[2]:.0f} % of the positions are within 3 std_position: is {truth} of this capture?"
            )
        typer.echo(json.dumps(_pose_data(score), indent=2) if as_json else columns(score.rows()))
        return
    evaluation = evaluate_run(run, truth, oracle, progress_for_stderr())
    typer.echo(json.dumps(_data(evaluation), indent=2) if as_json else columns(evaluation.rows()))


def _pose_data(score: "PoseScore") -> dict[str, Any]:
    return {
        "ate_m": score.ate_m,
        "ate_share": score.ate_share,
        "rotation_deg": score.rotation_deg,
        "turns_deg": score.turns_deg,
        "rpe_frames": score.rpe_frames,
        "rpe_m": score.rpe_m,
        "rpe_deg": score.rpe_deg,
        "located_share": score.located_share,
        "within_std_shares": score.honest_shares,
        "std_ratio": score.std_ratio,
        "focal_error": score.focal_error,
    }


def _data(evaluation: "Evaluation") -> dict[str, Any]:
    motion = evaluation.trajectory
    return {
        "corner_error_px": {
            "mean": motion.mean_px,
            "median": motion.median_px,
            "p95": motion.p95_px,
            "max": motion.max_px,
        },
        "located_share": motion.located_share,
        "within_three_std_share": evaluation.honest_share,
        "rotation": _rotation(evaluation),
        "panorama": _scores(evaluation.panorama),
        "oracle": _scores(evaluation.oracle),
        "below_oracle_db": evaluation.below_oracle_db,
    }


def _rotation(evaluation: "Evaluation") -> dict[str, float] | None:
    score = evaluation.rotation
    if score is None:
        return None
    return {"mean_deg": score.mean_deg, "max_deg": score.max_deg, "focal_error": score.focal_error}


def _scores(score: "ImageScore | None") -> dict[str, float] | None:
    return None if score is None else {"psnr_db": score.psnr_db, "ssim": score.ssim, "compared_share": score.compared_share}
