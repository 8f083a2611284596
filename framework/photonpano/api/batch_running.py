"""Do the jobs of a batch, each in a process of its own, and write the summary of their rows.

So a run begins with clean memory, and may crash or be killed: its row says how it ended.
"""

from __future__ import annotations

import csv
import io
import logging
import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import cv2

from photonpano.api.batch_jobs import Job, is_of_capture
from photonpano.capture.writing import truth_path
from photonpano.errors import InputError, OutputError, PhotonpanoError, SpecError, described
from photonpano.evaluation import evaluate
from photonpano.execution.context import Quiet
from photonpano.files.folders import atomic_path
from photonpano.files.paths import Url
from photonpano.pipeline.run import RunResult, run
from photonpano.record.batch_row import FIGURES, BatchRow, ranked, written
from photonpano.report import render_batch
from photonpano.report.drawing import jpeg_uri, shrunk

_THUMBNAIL_PIXELS = 240  # longer side
_LOOK_S = 0.1  # time between two looks whether the batch ends
_END_S = 2.0  # how long a run may take to remove its unfinished files when the batch ends
TABLE, PAGE = "summary.csv", "summary.html"
_FIRST = ("name", "capture", "run", "status", "verdict")


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
    record, motion = result.record, result.record["motion"]
    doubts = [str(each) for each in (result.verdict.reasons if result.verdict else ())]
    return replace(
        row,
        status="done",
        was_finished=result.was_finished,
        verdict="doubtful" if doubts else "trusted",
        reason="\n".join(doubts),
        reduced_chi2=result.verdict.reduced_chi2 if result.verdict else None,
        expected_error_px=motion["std_px"] if motion else None,
        **(result.kind.runs.figures(record) if result.kind else {}),
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
        score = (result.kind.runs.evaluate if result.kind else evaluate)(result.directory, truth)
        return replace(row, **score.figures())
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


def rows_of(jobs: Sequence[Job], n_workers: int) -> Generator[list[tuple[int, BatchRow]], None, None]:
    """Do jobs in their order, and yield the rows that have changed with their indices: those that begin, and those that end.

    At most `n_workers` run at once. When the generator is closed, or its caller is interrupted, these are ended.
    """
    waiting, going_on, batch_ends = iter(enumerate(jobs)), dict[Future[BatchRow], int](), Event()
    changed: list[tuple[int, BatchRow]] = []
    with ThreadPoolExecutor(n_workers) as pool:
        try:
            while True:
                while len(going_on) < n_workers and (following := next(waiting, None)) is not None:
                    index, job = following
                    going_on[pool.submit(_row_of, job, batch_ends)] = index
                    changed.append((index, replace(job.row, status="running")))
                yield changed
                if not going_on:
                    return
                ended, _ = wait(going_on, return_when=FIRST_COMPLETED)
                changed = [(going_on.pop(each), each.result()) for each in ended]
        finally:
            batch_ends.set()


def _row_of(job: Job, batch_ends: Event) -> BatchRow:
    """Do a job in a process, and return its row. The process and this one exchange files: libraries print what they like."""
    with tempfile.TemporaryDirectory() as folder:
        given, answer, printed = (Path(folder, name) for name in ("job", "row", "printed"))
        given.write_bytes(pickle.dumps(job))
        # -P: a file in the current folder must not take the place of a module.
        command: list[str | Path] = [sys.executable, "-P", "-m", "photonpano.api.batch_running", given, answer]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        with printed.open("wb") as out:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=out, env=environment)
            code = _exit_code(process, batch_ends)
        if answer.exists():
            row: BatchRow = pickle.loads(answer.read_bytes())
            return row
        return replace(job.row, status="failed", reason=_how_it_ended(code, printed))


def _exit_code(process: subprocess.Popen[bytes], batch_ends: Event) -> int:
    """Wait for the end of a process, and end it if the batch ends; return its exit code."""
    with process:
        while not batch_ends.is_set():
            with suppress(subprocess.TimeoutExpired):
                return process.wait(_LOOK_S)
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            return process.wait(_END_S)
        process.kill()  # code in C may keep it from ending
    return process.returncode


def _how_it_ended(code: int, printed: Path) -> str:
    """Describe the exit of a process that gave no row."""
    if code == -signal.SIGKILL:
        return (
            "the run was killed (SIGKILL), as the system does when memory runs out; lower run.memory or the number of jobs, "
            "or close other programs"
        )
    text = printed.read_text(encoding="utf-8", errors="replace")[-2000:]
    last = next(filter(None, reversed(text.splitlines())), "")
    how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended with the exit code {code}"
    return f"the run {how}{f': {last}' if last else ''}; a library or a plugin is to blame, or whoever sent the signal"


def write_summary(
    directory: Path,
    rows: Sequence[BatchRow],
    spec: str | Mapping[str, Any],
    common: Sequence[str],
    keys: Sequence[str],
) -> None:
    """Write both files, each whole or not at all, with the runs `ranked`; for the arguments, see `render_batch`."""
    rows = ranked(rows)
    page = render_batch(directory, rows, spec, common, keys)
    for name, text in ((TABLE, _table(directory, rows, keys)), (PAGE, page)):
        with atomic_path(directory / name, flushed=False) as temporary:
            temporary.write_text(text, encoding="utf-8", errors="backslashreplace", newline="")


def require_own(directory: Path) -> None:
    """Raise `OutputError` if the folder holds a summary that no batch has written."""
    path = directory / TABLE
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            own = file.readline().startswith(",".join(_FIRST))
    except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
        return
    except OSError as error:
        raise OutputError(f"{path} cannot be read ({error.strerror}); choose another folder with --output") from error
    if not own:
        raise OutputError(f"{path} is no summary of a batch, and would be replaced; choose another folder with --output")


def _table(directory: Path, rows: Sequence[BatchRow], keys: Sequence[str]) -> str:
    """Return the table in CSV: empty where a run has no such figure."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_FIRST, *keys, *FIGURES, "reason"])
    for row in rows:
        first = [row.name, str(row.capture), row.directory.relative_to(directory).as_posix(), row.status, row.verdict]
        settings = [written(row.settings[key]) for key in keys]
        writer.writerow([*first, *settings, *(getattr(row, name) for name in FIGURES), row.reason])
    return text.getvalue()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
