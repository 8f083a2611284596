"""Do one run of a batch: `python -m photonpano.api.batching.running JOB ROW` reads a pickled job, and writes its row."""

from __future__ import annotations

import logging
import pickle
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2

from photonpano.api.batching.sweeps import Job, is_of_capture
from photonpano.capture.writing import truth_path
from photonpano.errors import InputError, PhotonpanoError, SpecError, described
from photonpano.evaluation import evaluate, evaluate_poses
from photonpano.execution.context import Quiet
from photonpano.files.paths import Url
from photonpano.pipeline.run import RunResult, run
from photonpano.record.batch_row import BatchRow
from photonpano.report.drawing import jpeg_uri, shrunk

_THUMBNAIL_PIXELS = 240  # longer side


def run_job(job: Job) -> BatchRow:
    """Do one run, unless it was finished, and score it by the truth beside the capture; errors become the reason of the row."""
    with _warnings() as warnings:
        row = _attempted(job)
    return replace(row, reason="\n".join([row.reason, *warnings]).strip())


class _Warnings(logging.Handler):
    """Collects what is logged as a warning."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.found: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.found.append(f"warning: {record.getMessage()}")


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect what is logged as a warning while the block runs."""
    logger, handler = logging.getLogger("photonpano"), _Warnings()
    logger.addHandler(handler)
    try:
        yield handler.found
    finally:
        logger.removeHandler(handler)


def _attempted(job: Job) -> BatchRow:
    """Do a run; an error becomes the reason of its row."""
    try:
        plan = job.spec.plan(job.overrides, job.row.directory)
        if plan.run.threads == "auto":  # the record keeps `auto`: results do not depend on it
            plan = replace(plan, run=plan.run.model_copy(update={"threads": job.threads}))
        result = run(plan, Quiet(), overwrite=job.overwrite, resume=True)
        return _scored(_finished(job.row, result), result)
    except SpecError as error:
        own = [each for each in error.problems if is_of_capture(each.where)]
        reason = "\n".join(each.message for each in own) if len(own) == len(error.problems) else str(error)
        return replace(job.row, status="failed", reason=reason)
    except PhotonpanoError as error:
        return replace(job.row, status="failed", reason=str(error), report=error.report)
    except MemoryError:
        return replace(job.row, status="failed", reason="there is not enough memory; lower run.memory, or the number of jobs")
    except Exception as error:
        return replace(job.row, status="failed", reason=f"{described(error)} (a defect of photonpano or of a plugin)")


def _finished(row: BatchRow, result: RunResult) -> BatchRow:
    """Describe what a run has found."""
    record, poses, motion = result.record, result.record["poses"], result.record["motion"]
    doubts = [str(each) for each in (result.verdict.reasons if result.verdict else ())]
    return replace(
        row,
        status="done",
        was_finished=result.was_finished,
        verdict="doubtful" if doubts else "trusted",
        reason="\n".join(doubts),
        reduced_chi2=result.verdict.reduced_chi2 if result.verdict else None,
        expected_error_px=motion["std_px"] if motion else None,
        expected_position_error=poses["std_position"] if poses else None,
        n_frames=record["source"]["n_frames"],
        seconds=record["seconds"],
        peak_memory_bytes=record["peak_memory_bytes"],
        report=result.directory / "report.html" if "report.html" in record.get("files", {}) else None,
        thumbnail=_thumbnail(result.directory / "panorama.png"),
    )


def _scored(row: BatchRow, result: RunResult) -> BatchRow:
    """Add the score of a run whose truth lies beside the capture."""
    if isinstance(row.capture, Url) or not (truth := truth_path(row.capture)).exists():
        return row
    try:
        if result.record["poses"]:
            return replace(row, true_position_error=evaluate_poses(result.directory, truth).ate_share)
        score = evaluate(result.directory, truth)
        psnr_db = None if score.panorama is None else score.panorama.psnr_db
        return replace(row, true_error_px=score.trajectory.mean_px, psnr_db=psnr_db)
    except InputError as error:
        return replace(row, reason="\n".join(filter(None, (row.reason, f"no score: {error}"))))


def _thumbnail(picture: Path) -> str | None:
    image = cv2.imread(str(picture), cv2.IMREAD_ANYCOLOR) if picture.exists() else None
    if image is None:
        return None
    small = shrunk(image, _THUMBNAIL_PIXELS)
    return jpeg_uri(small if small.ndim == 2 else small[..., ::-1])


def main(job: Path, row: Path) -> None:
    """Do the job in a file, and write its row to another. SIGTERM ends the run as Ctrl-C does."""
    for each in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to all processes; the batch decides what ends
        signal.signal(each, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    unfinished = row.with_suffix(".partial")
    unfinished.write_bytes(pickle.dumps(run_job(pickle.loads(job.read_bytes()))))
    unfinished.rename(row)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
