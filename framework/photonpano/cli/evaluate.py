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
        typer.echo(json.dumps(_pose_data(score), indent=2) if as_json else columns(_pose_rows(score)))
        return
    evaluation = evaluate_run(run, truth, oracle, progress_for_stderr())
    typer.echo(json.dumps(_data(evaluation), indent=2) if as_json else columns(_rows(evaluation)))


def _rows(evaluation: "Evaluation") -> list[list[str]]:
    motion = evaluation.trajectory
    rows = [
        ["corner error, mean", f"{motion.mean_px:.3f} px"],
        ["corner error, median", f"{motion.median_px:.3f} px"],
        ["corner error, 95 %", f"{motion.p95_px:.3f} px"],
        ["corner error, worst frame", f"{motion.max_px:.3f} px"],
        ["frames located", f"{100 * motion.located_share:.1f} %"],
        ["frames within 3 std_px", f"{100 * evaluation.honest_share:.1f} %"],
    ]
    if evaluation.rotation is not None:
        rotation = evaluation.rotation
        rows += [
            ["rotation error, mean", f"{rotation.mean_deg:.4f} degrees"],
            ["rotation error, worst", f"{rotation.max_deg:.4f} degrees"],
            ["focal length", f"{100 * rotation.focal_error:+.3f} %"],
        ]
    for name, score in (("panorama", evaluation.panorama), ("oracle", evaluation.oracle)):
        if score is not None:
            rows += [[f"PSNR, {name}", f"{score.psnr_db:.2f} dB"], [f"SSIM, {name}", f"{score.ssim:.4f}"]]
    if evaluation.below_oracle_db is not None:
        rows.append(["PSNR below the oracle", f"{evaluation.below_oracle_db:.2f} dB"])
    return rows


def _pose_rows(score: "PoseScore") -> list[list[str]]:
    rows = [
        ["position error (ATE), rms", f"{score.ate_m:.4g} m, {100 * score.ate_share:.3f} % of the path"],
        ["rotation error, rms", f"{score.rotation_deg:.4f} degrees, {score.turns_deg:.4f} after the best common rotation"],
    ]
    if score.rpe_m is not None:
        rows.append([f"RPE over {score.rpe_frames} frames, rms", f"{score.rpe_m:.4g} m, {score.rpe_deg:.4f} degrees"])
    rows.append(["frames located", f"{100 * score.located_share:.1f} %"])
    if score.honest_shares is not None:
        shares = ", ".join(f"{100 * share:.1f} %" for share in score.honest_shares)
        rows += [["within 1, 2, 3 std_position", shares], ["error over std_position, rms", f"{score.std_ratio:.2f}"]]
    if score.focal_error is not None:
        rows.append(["focal length", f"{100 * score.focal_error:+.3f} %"])
    return rows


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
