"""One run with `pose`: open the capture, find the pose of every frame, write the run folder."""

from __future__ import annotations

import time

from photonpano.captures.fingerprint import fingerprint
from photonpano.captures.obstacles import naming_obstacles
from photonpano.context import Progress, usual
from photonpano.contracts.attribution import attributing
from photonpano.contracts.results import POSES
from photonpano.errors import InputError
from photonpano.pipeline.checkpoints.finished import finished_run
from photonpano.pipeline.components import build_pose_estimator
from photonpano.pipeline.failed_run import reporting_failure
from photonpano.pipeline.observers import Observers
from photonpano.pipeline.pose_files import write_pose_files
from photonpano.pipeline.run_steps import begun_run, first_decisions, require_centre, with_report
from photonpano.poses import in_standard_world
from photonpano.protocols import Source
from photonpano.record.pose_record import poses_record, poses_warnings
from photonpano.record.run_json import started_record
from photonpano.record.schema import RunRecord
from photonpano.report import render_pose_report
from photonpano.specs.plan import Plan
from photonpano.values import CameraGuess, Decision, PoseEstimate


def run_poses(
    plan: Plan, progress: Progress | None = None, *, overwrite: bool = False, resume: bool = False, keeps_work: bool = False
) -> tuple[RunRecord, bool]:
    """Run a plan with a pose estimator, and write its run folder.

    Args:
        plan: from `load_spec` or `parse_spec`.
        progress: receives stages and messages; by default, bars in a notebook and nothing elsewhere.
        overwrite: whether the run folder may hold files that no run has written, which stay, or a run of another capture.
        resume: take the results of a finished run of the same spec, capture and versions; an interrupted one begins anew,
            since such a run keeps nothing to go on with.
        keeps_work: whether the caller asks for work that is kept, which is refused.

    Returns:
        The content of `run.json`, and whether `resume` found that nothing was left to do.

    Raises:
        InputError: the capture cannot be used, shows nothing, or does not suit the plan; or `keeps_work`.
        LocationError: the poses could not be found.
        PluginError: the pose estimator failed in its own way, or broke its contract.
        OutputError: the run folder cannot be written, or another process writes it; it is as it was.
    """
    if keeps_work:
        raise InputError("a run with `pose` has no levels to keep or to go on from: leave out --keep-work and --from-level")
    progress = usual(progress)
    observers = Observers(plan.observers, plan.output.directory)
    with begun_run(plan, observers, progress, overwrite=overwrite) as begun:
        source, folder = begun.source, begun.folder
        capture = fingerprint(plan, source)
        if resume:
            if (done := finished_run(plan, capture)) is not None:
                begun.finished(done)
                return done, True
            progress.note("a run with `pose` keeps no work: it begins anew")
        decisions = first_decisions(plan, source)
        start = time.perf_counter()
        with reporting_failure(plan, begun, decisions, (), capture), naming_obstacles(source, decisions):
            estimate = _estimated(plan, source, decisions, progress)
        observers.posed(estimate, time.perf_counter() - start)
        warnings = [*poses_warnings(estimate), *write_pose_files(folder.staging, estimate, source.info, plan.output.exposures)]
        record = folder.commit(
            {
                **started_record(plan, source.info, decisions, begun.seconds, capture),
                "poses": poses_record(estimate),
                "warnings": warnings,
            }
        )
        record = with_report(folder, record, lambda record: render_pose_report(record, estimate))
        begun.finished(record)
    return record, False


def camera_guess(plan: Plan) -> CameraGuess:
    """Return what a spec says about the camera."""
    camera, given = plan.camera, plan.camera.distortion.model_dump()
    k1, k2, p1, p2 = (float(given[name]) for name in ("k1", "k2", "p1", "p2"))
    return CameraGuess(None if camera.focal_px == "find" else camera.focal_px, camera.centre_px, (k1, k2, p1, p2))


def _estimated(plan: Plan, source: Source, decisions: list[Decision], progress: Progress) -> PoseEstimate:
    """Return the poses, checked, in a world in which the path has the length 1."""
    assert plan.pose is not None
    require_centre(plan, source)
    estimator = build_pose_estimator(plan, source, decisions)
    with attributing(plan.pose.label, "the capture"):
        return in_standard_world(POSES.require(estimator.estimate(source, camera_guess(plan), progress), source.info))
