"""Do the runs of a batch, each in a process of its own, and collect their rows.

So a run begins with clean memory, and may crash or be killed: its row says how it ended.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import tempfile
from collections.abc import Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event

from photonpano.api.batching.sweeps import Job
from photonpano.record.batch_row import BatchRow

_LOOK_S = 0.1  # time between two looks whether the batch ends
_END_S = 2.0  # how long a run may take to remove its unfinished files when the batch ends


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
        command: list[str | Path] = [sys.executable, "-P", "-m", "photonpano.api.batching.running", given, answer]
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
