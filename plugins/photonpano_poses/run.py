"""A run with `pose`: estimate the poses, write their files, describe them for `run.json`, judge them, and end the run."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from photonpano import FloatArray, OutputError, Plan, StreamInfo, Verdict
from photonpano.contracts.attribution import blaming
from photonpano.geometry import Camera, positions_of
from photonpano.pipeline.components import build_finder
from photonpano.pipeline.estimate import require_centre
from photonpano.pipeline.obstacles import naming_obstacles
from photonpano.pipeline.run import BegunRun
from photonpano.record.picture_files import png_of
from photonpano.record.run_json import verdict_record
from photonpano.text import counted
from photonpano.values.verdict import Found, Test, judged
from photonpano_poses.contract import CameraGuess, PoseEstimate, require_poses
from photonpano_poses.depth import fused
from photonpano_poses.files import (
    Poses,
    colmap,
    depth_name,
    in_standard_world,
    nerfstudio,
    picture_of,
    ply,
    splats_ply,
    surface_ply,
    tum,
)
from photonpano_poses.page import render_pose_report
from photonpano_poses.scores import PoseScore, evaluate_poses

_SHOWN_LOST = 3  # spans of lost frames that a warning names
_TELLING = 16.0  # squared distance of two predictions, in units of photon noise, that photons tell apart
_PATCH_PX = 8  # side of the patches whose depth is held against photons that were left out
_FEW = 0.1  # if fewer positions lie within 3 expected errors, the truth is probably of another capture
logger = logging.getLogger("photonpano")


class PoseRuns:
    """Does runs with `pose`, and describes them: a `RunKind`."""

    def run(self, run: BegunRun) -> None:
        """Estimate the poses, write their files, and end the run."""
        plan, source, start = run.plan, run.source, time.perf_counter()
        require_centre(plan, source)
        with naming_obstacles(source):
            estimator = build_finder(plan, source, run.journal)
            estimate = estimator.estimate(source, camera_guess(plan), run.progress)
            with blaming(estimator):
                found = in_standard_world(require_poses(estimate, source))
        run.observers.stage_finished(None, "pose", time.perf_counter() - start, counts_of(found))
        files = write_pose_files(run.folder.staging, found, source.info, plan.output.exposures)
        verdict = judge_poses(found)
        warnings, of_poses = [*poses_warnings(found), *files], {"poses": poses_record(found, verdict)}
        record: Any = {**run.started_record(), **of_poses, "verdict": verdict_record(verdict), "warnings": warnings}
        run.end(record, lambda record: render_pose_report(record, found), verdict)

    def rows(self, record: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Return how many frames have a pose."""
        return [("located", f"{record['poses']['located']:,} of {counted(record['source']['n_frames'], 'frame')}")]

    def figures(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return the expected error of the positions."""
        return {"expected_position_error": record["poses"]["std_position"]}

    def evaluate(self, run_folder: Path, truth: Path) -> PoseScore:
        """Score the poses of a run, and warn of a truth that is probably that of another capture."""
        score = evaluate_poses(run_folder, truth)
        if score.honest_shares is not None and score.honest_shares[2] < _FEW:
            share = f"{100 * score.honest_shares[2]:.0f} % of the positions are within 3 std_position"
            logger.warning("%s: is %s of this capture?", share, truth)
        return score


def camera_guess(plan: Plan) -> CameraGuess:
    """Return what a spec says about the camera."""
    camera, given = plan.camera, plan.camera.distortion.model_dump()
    k1, k2, p1, p2 = (float(given[name]) for name in ("k1", "k2", "p1", "p2"))
    return CameraGuess(None if camera.focal_px == "find" else camera.focal_px, camera.centre_px, (k1, k2, p1, p2))


def write_pose_files(folder: Path, estimate: PoseEstimate, stream: StreamInfo, exposures: bool) -> list[str]:
    """Write poses.npz, sparse/, transforms.json, points.ply, poses.tum, and with `exposures` pictures in images/.

    With depth also its maps in depth/, and splats.ply.

    The path of the estimate has the length 1. Returns warnings; `OutputError` if the disk is full.
    """
    try:
        _write(folder, estimate, stream)
        for name, view in zip(view_names(estimate, stream.n_frames), estimate.views if exposures else (), strict=False):
            (folder / "images").mkdir(exist_ok=True)
            (folder / "images" / name).write_bytes(png_of(picture_of(view.flux())))
    except OSError as error:
        reason = error.strerror or "a file was cut short"
        raise OutputError(f"the poses could not be written ({reason}); what was in the run folder is unchanged") from error
    if stream.frame_rate_hz is None:
        return ["poses.tum is not written, since the capture gives no frame rate: set source.with.frame_rate_hz"]
    return []


def view_names(estimate: PoseEstimate, n_frames: int) -> tuple[str, ...]:
    """Return the file names of the exposures, by the first of their frames, such as `exposure_0250.png`."""
    digits = len(str(n_frames - 1))
    return tuple(f"exposure_{view.span.start:0{digits}}.png" for view in estimate.views)


def _write(folder: Path, estimate: PoseEstimate, stream: StreamInfo) -> None:
    camera = Camera(estimate.camera_matrix, estimate.distortion)
    saved = ("camera_from_world", "camera_matrix", "distortion", "located", "std_position", "std_rotation_deg")
    np.savez(
        folder / "poses.npz",
        allow_pickle=False,
        **{name: getattr(estimate, name) for name in saved},
        frame_shape=np.array(stream.frame_shape),
        frame_rate_hz=np.array(np.nan if stream.frame_rate_hz is None else stream.frame_rate_hz),
    )
    rate = stream.frame_rate_hz or 1.0
    seen = _of_views(camera, estimate, stream, rate)
    (folder / "sparse").mkdir()
    for name, text in colmap(seen).items():
        (folder / "sparse" / name).write_text(text, encoding="utf-8")
    for name, text in nerfstudio(seen).items():
        (folder / name).write_text(text, encoding="utf-8")
    if estimate.depth:
        _write_depth(folder, estimate, seen.names)
    else:
        (folder / "points.ply").write_bytes(ply(estimate.points))
    if stream.frame_rate_hz is not None:
        frames = np.flatnonzero(estimate.located)
        poses = estimate.camera_from_world[frames]
        names = tuple(map(str, frames.tolist()))
        to_world = np.swapaxes(poses[:, :, :3], -1, -2)
        located = Poses(
            camera=camera,
            frame_shape=stream.frame_shape,
            names=names,
            rotations=to_world,
            seconds=frames / rate,
            positions=positions_of(poses),
        )
        (folder / "poses.tum").write_text(tum(located)["trajectory.txt"], encoding="utf-8")


def _write_depth(folder: Path, estimate: PoseEstimate, names: Sequence[str]) -> None:
    """Write the depth maps and their errors as TIFF, 0 where the depth is not known, and the surface that they show."""
    (folder / "depth").mkdir()
    for each in estimate.depth:
        q, known = each.inverse_depth, np.isfinite(each.inverse_depth)
        for suffix, values in (("", 1 / q), ("_std", each.std / q**2)):
            picture = np.where(known, values, np.float32(0)).astype(np.float32)
            (folder / depth_name(names[each.view], suffix)).write_bytes(cv2.imencode(".tif", picture)[1].tobytes())
    surface = fused(estimate)
    (folder / "points.ply").write_bytes(surface_ply(surface))
    (folder / "splats.ply").write_bytes(splats_ply(surface))


def _of_views(camera: Camera, estimate: PoseEstimate, stream: StreamInfo, rate: float) -> Poses:
    """Return the poses of the exposures, with what they show."""
    poses = np.array([view.camera_from_world for view in estimate.views]).reshape(-1, 3, 4)
    return Poses(
        camera=camera,
        frame_shape=stream.frame_shape,
        names=view_names(estimate, stream.n_frames),
        rotations=np.swapaxes(poses[:, :, :3], -1, -2),
        seconds=np.array([view.instant for view in estimate.views]) / rate,
        positions=positions_of(poses),
        observed=tuple((np.asarray(view.points), view.xy) for view in estimate.views),
        points=estimate.points,
        have_depth=0 < len(estimate.depth) == len(estimate.views),
    )


def counts_of(estimate: PoseEstimate) -> Mapping[str, int]:
    """Return how many frames were located, by how many exposures, with how many points."""
    return {
        "located": int(estimate.located.sum()),
        "exposures": len(estimate.views),
        "points": len(estimate.points.positions),
    }


def poses_record(estimate: PoseEstimate, verdict: Verdict) -> dict[str, Any]:
    """Describe an estimate and the doubts of its verdict for `run.json`, in a world in which the path has the length 1.

    Expected errors are those of the located frames, root mean square; None where the estimator knows none.
    """
    camera = Camera(estimate.camera_matrix, estimate.distortion)
    std_focal_px = float(estimate.std_focal_px)
    return {
        "camera": {
            "focal_px": camera.focal_px,
            "std_focal_px": std_focal_px if np.isfinite(std_focal_px) else None,
            "centre_px": list(camera.centre_px),
            "distortion": camera.distortion.tolist(),
            "std_distortion": [0.0] * 4,
        },
        **counts_of(estimate),
        "std_position": _rms(estimate.std_position[estimate.located]),
        "std_rotation_deg": _rms(estimate.std_rotation_deg[estimate.located]),
        "depth": depth_record(estimate),
        "lost": [{"frames": [each.span.start, each.span.stop], "reason": each.reason} for each in estimate.lost],
        "levels": [dict(level) for level in estimate.levels],
        "doubts": [str(reason) for reason in verdict.reasons],
    }


def depth_record(estimate: PoseEstimate) -> dict[str, Any] | None:
    """Describe the depth maps of an estimate for `run.json`; None without any."""
    if not estimate.depth:
        return None
    known = [np.isfinite(each.inverse_depth) for each in estimate.depth]
    relative = np.concatenate([(each.std / each.inverse_depth)[seen] for each, seen in zip(estimate.depth, known, strict=True)])
    return {
        "exposures": len(estimate.depth),
        "share": float(np.mean(known)),
        "std_share": float(np.median(relative)) if len(relative) else None,
        "held_out_share": _held_out(estimate),
    }


def _held_out(estimate: PoseEstimate) -> float | None:
    """Return the share of patches whose photons, which were left out, prefer another depth; None if no patch can tell.

    Compared are the deviances, sum((k - m)^2 / v), of the photons k from what the other exposures predict, m, at the depth
    that was found and at 3 expected errors nearer and farther; v is the variance of photon noise. If the found depth is right,
    the difference has the mean A = sum((m' - m)^2 / v) and the variance 4 A, so that patches with A > 16 can tell: chance
    makes 2 % of them prefer m'.
    """
    telling, prefer = 0, 0
    for each in estimate.depth:
        view = estimate.views[each.view]
        flux, others = view.flux(), (each.flux_nearer, each.flux_farther)
        known = np.isfinite(each.inverse_depth) & np.isfinite(flux) & np.isfinite(others).all(axis=0) & (each.flux > 0)
        # Of binary frames, and nearly so of counts.
        weight = len(view.span) / np.expm1(np.where(known, each.flux, 1))
        found = _in_patches(np.where(known, weight * (flux - each.flux) ** 2, 0))
        told = [_in_patches(np.where(known, weight * (other - each.flux) ** 2, 0)) > _TELLING for other in others]
        better = [_in_patches(np.where(known, weight * (flux - other) ** 2, 0)) < found for other in others]
        telling += int(np.any(told, axis=0).sum())
        prefer += int((np.array(told) & better).any(axis=0).sum())
    return prefer / telling if telling else None


def _in_patches(values: FloatArray) -> FloatArray:
    """Return the sums of (H, W) values over squares of 8 px."""
    height, width = (size // _PATCH_PX for size in values.shape)
    whole = values[: height * _PATCH_PX, : width * _PATCH_PX]
    return np.asarray(whole.reshape(height, _PATCH_PX, width, _PATCH_PX).sum(axis=(1, 3)))


def poses_warnings(estimate: PoseEstimate) -> list[str]:
    """Warn of frames without a pose."""
    if estimate.located.all():
        return []
    lost, frames = int((~estimate.located).sum()), len(estimate.located)
    spans = "; ".join(f"{each.span}: {each.reason}" for each in estimate.lost[:_SHOWN_LOST])
    more = f"; and {len(estimate.lost) - _SHOWN_LOST} more spans" if len(estimate.lost) > _SHOWN_LOST else ""
    return [f"{lost} of {frames} frames have no pose ({spans}{more})"]


def judge_poses(estimate: PoseEstimate) -> Verdict:
    """Judge an estimate in a world in which the path has the length 1."""
    return judged(TESTS, estimate, estimate.residual_ratio, estimate.doubts)


def _residuals(estimate: PoseEstimate) -> Found | None:
    return None if estimate.residual_ratio is None else Found(estimate.residual_ratio)


def _position(estimate: PoseEstimate) -> Found | None:
    return _expected(100 * estimate.std_position[estimate.located], "% of the path, root mean square")


def _rotation(estimate: PoseEstimate) -> Found | None:
    return _expected(estimate.std_rotation_deg[estimate.located], "degrees, root mean square")


def _expected(std: FloatArray, unit: str) -> Found | None:
    figure = _rms(std)
    return None if figure is None else Found(figure, unit)


def _rms(std: FloatArray) -> float | None:
    """Return the root mean square; None where an error is not known."""
    return float(np.sqrt(np.mean(std**2))) if len(std) and np.isfinite(std).all() else None


def _unknown(estimate: PoseEstimate) -> Found:
    known = np.isfinite(estimate.std_position) & np.isfinite(estimate.std_rotation_deg)
    return Found(float((~known[estimate.located]).mean()), "share of the frames with a pose")


def _lost(estimate: PoseEstimate) -> Found:
    lost, frames = int((~estimate.located).sum()), len(estimate.located)
    return Found(lost / frames, f"{lost} of {frames} frames")


def _depth_share(estimate: PoseEstimate) -> Found | None:
    record = depth_record(estimate)
    return None if record is None else Found(1 - record["share"], "share of the pixels of key exposures")


def _depth_held_out(estimate: PoseEstimate) -> Found | None:
    share = _held_out(estimate)
    return None if share is None else Found(share, "share of the patches of key exposures that can tell")


def _depth_std(estimate: PoseEstimate) -> Found | None:
    record = depth_record(estimate)
    if record is None or record["std_share"] is None:
        return None
    return Found(100 * record["std_share"], "% of the depth, median")


_MORE_LIGHT = "use more light, a longer path, or more frames of it; or another pose.with.group_size"
TESTS: tuple[Test[PoseEstimate], ...] = (
    Test(
        "the poses do not explain the photons: points are farther from where exposures show them than noise explains",
        1.0,
        "the poses are likely wrong: move farther, or choose another pose.with.group_size",
        _residuals,
    ),
    Test("the expected error of the positions is large", 0.3, _MORE_LIGHT, _position),
    Test("the expected error of the rotations is large", 5.0, _MORE_LIGHT, _rotation),
    Test("the expected errors are not known", 0, "use a pose estimator that knows them, or more light", _unknown),
    Test("many frames have no pose", 0.5, "see the reasons under `lost`; choose another pose.with.group_size", _lost),
    Test("many pixels have no depth", 0.5, "use more light, a longer path, or a scene with more texture", _depth_share),
    Test(
        "photons that were left out prefer another depth, by 3 expected errors",
        0.25,
        "the depth is likely wrong: check the focal length and the lens, or use a longer path",
        _depth_held_out,
    ),
    Test("the expected error of the depth is large", 10.0, "move farther across the view, or use more light", _depth_std),
)
