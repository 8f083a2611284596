"""Do the runs of a batch, each in a process of its own, and collect their rows.

The fork server of `multiprocessing` imports the libraries once and forks for each run. So a run starts at once, begins with
clean memory, and may crash or be killed: its row says how it ended.
"""

from __future__ import annotations

import fcntl
import multiprocessing.forkserver
import os
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from types import ModuleType
from typing import Any

from photonpano.api.batching.sweeps import Job
from photonpano.files.atomic import discard_unfinished
from photonpano.record.batch_row import BatchRow

_END_S = 0.5  # how long a run may take to discard unfinished files when the batch ends
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}  # a process with threads cannot be forked


def rows_of(jobs: Sequence[Job], n_workers: int) -> Generator[list[tuple[int, BatchRow]], None, None]:
    """Do jobs in their order, and yield the rows that have changed with their indices: those that begin, and those that end.

    At most `n_workers` run at once. When the generator is closed, or its caller is interrupted, these are ended.
    """
    waiting, going_on = iter(enumerate(jobs)), dict[int, _Run]()
    with tempfile.TemporaryDirectory() as folder:
        try:
            changed: list[tuple[int, BatchRow]] = []
            while True:
                while len(going_on) < n_workers and (following := next(waiting, None)) is not None:
                    index, job = following
                    going_on[index] = _started(job, Path(folder, str(index)))
                    changed.append((index, replace(job.row, status="running")))
                yield changed
                if not going_on:
                    return
                # A process that a run has started may hold its pipe open when the run has ended.
                ready = wait([each for run in going_on.values() for each in (run.answers, run.process.sentinel)])
                ended = [index for index, run in going_on.items() if run.answers in ready or run.process.sentinel in ready]
                changed = [(index, going_on.pop(index).row()) for index in ended]
        finally:
            for run in going_on.values():
                run.lifeline.close()
            last = time.monotonic() + _END_S
            for run in going_on.values():  # C code may hold the interpreter of one that goes on
                run.process.join(max(0.0, last - time.monotonic()))
                run.process.kill()
                run.process.join()


@dataclass(frozen=True)
class _Run:
    """A process that does a job; it ends when its lifeline is closed."""

    job: Job
    process: multiprocessing.process.BaseProcess
    answers: Connection
    lifeline: Connection
    printed: Path

    def row(self) -> BatchRow:
        """Wait until the process has ended, and return its row."""
        row = None
        with suppress(EOFError, OSError):
            if self.answers.poll():
                row = self.answers.recv()
        self.process.join()
        self.lifeline.close()
        self.answers.close()
        return row or replace(self.job.row, status="failed", reason=_how_it_ended(self.process.exitcode or 0, self.printed))


class _Process(ForkServerProcess):
    """A process that does not import the main module, which may be a script that begins a batch without a guard."""

    @staticmethod
    def _Popen(process: Any) -> Any:  # noqa: N802
        with _without_main():
            return ForkServerProcess._Popen(process)


@contextmanager
def _without_main() -> Iterator[None]:
    main, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _started(job: Job, printed: Path) -> _Run:
    """Start a process for a job; what it prints goes to a file."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["photonpano.api.batching.preload"])
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        with _without_main():
            multiprocessing.forkserver.ensure_running()
    finally:
        os.environ.update({name: value for name, value in before.items() if value is not None})
        for name in [name for name, value in before.items() if value is None]:
            del os.environ[name]
    (answers, answer), (life, lifeline) = context.Pipe(duplex=False), context.Pipe(duplex=False)
    process = _Process(target=_work, args=(job, answer, life, printed))
    process.start()
    answer.close()
    life.close()
    return _Run(job, process, answers, lifeline, printed)


def _work(job: Job, answer: Connection, life: Connection, printed: Path) -> None:
    """Do a job, answer with its row, and end."""
    code = 1
    try:
        # The system kills this process when that of the batch is killed: C code may hold the interpreter.
        parent = multiprocessing.parent_process()
        if parent is not None and hasattr(fcntl, "F_SETSIG"):
            fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, os.O_ASYNC)
        with printed.open("wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        threading.Thread(target=_end_with, args=(life,), daemon=True).start()
        from photonpano.api.batching.running import run_job  # heavy: the batch itself does not need it

        answer.send(run_job(job))
        code = 0
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(code)  # whatever threads a plugin has left


def _end_with(life: Connection) -> None:
    """End this process when its lifeline is closed, and leave no unfinished file."""
    with suppress(EOFError, OSError):
        life.recv_bytes()
    discard_unfinished()
    os._exit(1)


def _how_it_ended(code: int, printed: Path) -> str:
    """Describe the exit of a process that sent no row."""
    if code == -signal.SIGKILL:
        return (
            "the run was killed (SIGKILL), as the system does when memory runs out; lower run.memory or the number of jobs, "
            "or close other programs"
        )
    text = printed.read_text(encoding="utf-8", errors="replace")[-2000:] if printed.exists() else ""
    last = next(filter(None, reversed(text.splitlines())), "")
    how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended with the exit code {code}"
    return f"the run {how}{f': {last}' if last else ''}; a library or a plugin is to blame, or whoever sent the signal"
