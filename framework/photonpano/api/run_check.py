"""Judge a finished run by its capture."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photonpano.context import Context, Progress, Quiet
from photonpano.corrections import VIGNETTE_DECISION, divided_by
from photonpano.errors import InputError, SpecError
from photonpano.evaluation import RunTrajectory, load_run_trajectory
from photonpano.geometry import FrameTrajectory
from photonpano.lighting import in_light_of
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.components import open_source
from photonpano.pipeline.estimate import vignette_of
from photonpano.protocols import Source
from photonpano.record.contents import require_one_run, require_same_frames
from photonpano.record.run_json import read_record
from photonpano.record.schema import RunRecord
from photonpano.registry import Catalog
from photonpano.residuals.refinement import Look, refine
from photonpano.residuals.verdict import REPEATS, Reason, Verdict, contradictions, judge
from photonpano.specs import Plan, parse_spec
from photonpano.threads import one_thread_inside, thread_count
from photonpano.values import Decision, FrameSpan, StreamInfo


@dataclass(frozen=True, slots=True)
class RunCheck:
    """What `check_run` found.

    Attributes:
        verdict: whether motion and panorama explain the photons.
        unknown: what could not be judged, a sentence each.
    """

    verdict: Verdict
    unknown: tuple[str, ...]


def check_run(run_folder: Path | str, progress: Progress | None = None, catalog: Catalog | None = None) -> RunCheck:
    """Judge a finished run: render the panorama along its motion, and compare it with the photons of the capture.

    Writes nothing. The panorama is rendered with the scale of the frames, whatever that of the run was. What only the loop can
    find, such as pairs that fit at several places, is taken from the record.

    Args:
        run_folder: written by `run`.
        progress: receives the stages; quiet by default.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: the folder is no run folder, its capture cannot be opened, or it is another capture now.
    """
    folder = Path(run_folder)
    require_one_run(folder, ["trajectory.npz"])
    run = load_run_trajectory(folder, needs_std_px=False)
    record = read_record(folder)
    with _capture(folder, record, catalog) as (plan, source), one_thread_inside():
        _require_same_capture(folder, run, source.info)
        require_same_frames(folder, record, source)
        motion = _motion(run)
        if _divided_by_vignette(record) and (vignette := vignette_of(plan, source, motion.trajectory)):
            source = divided_by(source, vignette)
        source = in_light_of(source, folder)
        context = Context(thread_count(plan.run.threads), progress or Quiet())
        rendering = plan.render.tolerance_px, int(plan.run.memory), context
        explained = refine(source, Look(source, motion, *rendering), (), *rendering)
    verdict = judge(explained, (), [Decision(**decision) for decision in record.get("decisions", ())])
    unknown = []
    if np.isnan(run.std_px).any():
        unknown.append("trajectory.npz has no std_px, as it is of an older version: the expected error is not judged")
    pairs = _pairs(record)
    if pairs is None:
        unknown.append("run.json does not list contradicting pairs, as it is of an older version: they are not judged")
    elif (reason := contradictions(*pairs)) is not None:
        verdict = _with(verdict, reason)
    for found in (record.get("verdict") or {"reasons": ()})["reasons"]:
        if found["what"] == REPEATS:
            verdict = _with(verdict, Reason(**found))
    return RunCheck(verdict, tuple(unknown))


@contextmanager
def _capture(folder: Path, record: RunRecord, catalog: Catalog | None) -> Iterator[tuple[Plan, Source]]:
    """Open the capture of a run by the spec that the run recorded."""
    try:
        plan = parse_spec(record["spec"], name=str(folder / "run.json"), catalog=catalog)
        opened = open_source(plan)
        source = opened.__enter__()
    except SpecError as error:
        problems = "; ".join(f"{problem.where}: {problem.message}" for problem in error.problems)
        raise InputError(f"{folder}: the capture of this run cannot be opened by its recorded spec ({problems})") from error
    try:
        yield plan, source
    finally:
        opened.__exit__(None, None, None)


def _require_same_capture(folder: Path, run: RunTrajectory, stream: StreamInfo) -> None:
    n_frames, (height, width) = len(run.homographies), run.frame_shape
    if (stream.n_frames, *stream.frame_shape) != (n_frames, height, width):
        raise InputError(
            f"{folder} is a run of {n_frames:,} frames of {height}x{width}, but its capture now has {stream.n_frames:,} frames "
            f"of {stream.height}x{stream.width}; it is another capture"
        )
    if not run.located.any():
        raise InputError(f"{folder}: the run located no frame, so that there is nothing to judge")


def _motion(run: RunTrajectory) -> FrameMotion:
    """Return the motion of a run. An expected error that the run did not record is 0, so that it is not judged."""
    known = np.flatnonzero(run.located)
    span = FrameSpan(int(known[0]), int(known[-1]) + 1)
    reference = int(np.abs(run.homographies - np.eye(3)).max(axis=(1, 2)).argmin())
    trajectory = FrameTrajectory(run.homographies)
    std_px = np.where(run.located, np.nan_to_num(run.std_px, posinf=np.inf), np.inf)
    return FrameMotion(trajectory, span, run.homographies, run.located, std_px, reference, run.frame_shape)


def _divided_by_vignette(record: RunRecord) -> bool:
    """Return whether the run found a vignette; one that it did not divide by is still in its panorama."""
    return any(decision["what"] == VIGNETTE_DECISION for decision in record.get("decisions", ()))


def _pairs(record: RunRecord) -> tuple[int, int] | None:
    """Return the contradicting pairs of the last level and all of its pairs; None if the record does not list them."""
    try:
        last = record["levels"][-1]
        return len(last["contradictions"]), int(last["pairs"])
    except (KeyError, IndexError, TypeError, ValueError):
        return None


def _with(verdict: Verdict, reason: Reason) -> Verdict:
    return Verdict("doubtful", (*verdict.reasons, reason), verdict.residual_ratio)
