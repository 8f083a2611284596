"""Find the pose of every frame, and write the files of a run with `pose`."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from photonpano.contracts.results import POSES
from photonpano.contracts.rules import attributing
from photonpano.errors import OutputError
from photonpano.geometry import Camera, positions_of
from photonpano.photometry import tone_mapped
from photonpano.pipeline.components import build_pose_estimator
from photonpano.pipeline.estimate import require_centre
from photonpano.pipeline.obstacles import naming_obstacles
from photonpano.pipeline.run_steps import BegunRun
from photonpano.record.picture_files import png_of
from photonpano.record.poses import Poses, colmap, in_standard_world, nerfstudio, ply, tum
from photonpano.record.run_json import poses_record, verdict_record
from photonpano.record.run_warnings import poses_warnings
from photonpano.record.schema import RunRecord
from photonpano.report import render_pose_report
from photonpano.residuals.pose_verdict import judge_poses
from photonpano.specs.plan import Plan
from photonpano.values import CameraGuess, FluxImage, PoseEstimate, StreamInfo

_WHITE_QUANTILE = 0.995  # quantile of the flux of an exposure that is white in its picture


def find_poses(run: BegunRun) -> None:
    """Estimate the poses, write their files, and end the run."""
    plan, source, start = run.plan, run.source, time.perf_counter()
    with naming_obstacles(source, run.journal):
        estimate = _estimated(run)
    run.observers.posed(estimate, time.perf_counter() - start)
    files = write_pose_files(run.folder.staging, estimate, source.info, plan.output.exposures)
    verdict = judge_poses(estimate)
    record: RunRecord = {
        **run.started_record(),
        "poses": poses_record(estimate, verdict),
        "verdict": verdict_record(verdict),
        "warnings": [*poses_warnings(estimate), *files],
    }
    run.end(record, lambda record: render_pose_report(record, estimate), verdict)


def camera_guess(plan: Plan) -> CameraGuess:
    """Return what a spec says about the camera."""
    camera, given = plan.camera, plan.camera.distortion.model_dump()
    k1, k2, p1, p2 = (float(given[name]) for name in ("k1", "k2", "p1", "p2"))
    return CameraGuess(None if camera.focal_px == "find" else camera.focal_px, camera.centre_px, (k1, k2, p1, p2))


def _estimated(run: BegunRun) -> PoseEstimate:
    """Return the poses, checked, in a world in which the path has the length 1."""
    plan, source = run.plan, run.source
    assert plan.pose is not None
    require_centre(plan, source)
    estimator = build_pose_estimator(plan, source, run.journal)
    with attributing(plan.pose.label, "the capture"):
        return in_standard_world(POSES.require(estimator.estimate(source, camera_guess(plan), run.progress), source.info))


def write_pose_files(folder: Path, estimate: PoseEstimate, stream: StreamInfo, exposures: bool) -> list[str]:
    """Write poses.npz, sparse/, transforms.json, points.ply, poses.tum, and with `exposures` pictures in images/.

    The path of the estimate has the length 1. Returns warnings; `OutputError` if the disk is full.
    """
    try:
        _write(folder, estimate, stream)
        for name, view in zip(view_names(estimate, stream.n_frames), estimate.views if exposures else (), strict=False):
            (folder / "images").mkdir(exist_ok=True)
            (folder / "images" / name).write_bytes(_picture(view.flux()))
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
    np.savez(
        folder / "poses.npz",
        allow_pickle=False,
        camera_from_world=estimate.camera_from_world,
        camera_matrix=estimate.camera_matrix,
        distortion=estimate.distortion,
        located=estimate.located,
        std_position=estimate.std_position,
        std_rotation_deg=estimate.std_rotation_deg,
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
    (folder / "points.ply").write_bytes(ply(estimate.points))
    if stream.frame_rate_hz is not None:
        frames = np.flatnonzero(estimate.located)
        poses = estimate.camera_from_world[frames]
        names = tuple(map(str, frames.tolist()))
        to_world = np.swapaxes(poses[:, :, :3], -1, -2)
        located = Poses(camera, stream.frame_shape, names, to_world, frames / rate, positions_of(poses))
        (folder / "poses.tum").write_text(tum(located)["trajectory.txt"], encoding="utf-8")


def _of_views(camera: Camera, estimate: PoseEstimate, stream: StreamInfo, rate: float) -> Poses:
    """Return the poses of the exposures, with what they show."""
    poses = np.array([view.camera_from_world for view in estimate.views]).reshape(-1, 3, 4)
    return Poses(
        camera,
        stream.frame_shape,
        view_names(estimate, stream.n_frames),
        np.swapaxes(poses[:, :, :3], -1, -2),
        np.array([view.instant for view in estimate.views]) / rate,
        positions_of(poses),
        tuple((np.asarray(view.points), view.xy) for view in estimate.views),
        estimate.points,
    )


def _picture(flux: FluxImage) -> bytes:
    """Return an exposure as PNG, 8 bits in sRGB."""
    known = np.isfinite(flux)
    white = float(np.quantile(flux[known], _WHITE_QUANTILE)) if known.any() else 1.0
    return png_of(tone_mapped(flux, max(white, 1e-12)))
