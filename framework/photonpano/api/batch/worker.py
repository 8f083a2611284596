"""Do the runs of a batch, each in a process of its own: the program of a worker.

A worker imports the libraries once, and then forks for each run. So a run starts at once, begins with clean memory, and may
crash or be killed: the worker tells the batch how it ended. The batch gives a worker one job at a time over a connection. When
that is closed, since the batch was stopped or killed, the worker ends its run and itself.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection, Pipe, wait
from typing import IO, TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from photonpano.api.batch.job import Job
    from photonpano.record.batch_row import BatchRow
    from photonpano.registry import Catalog

_GRACE_S = 0.5
"""How long a run may take to discard unfinished files when the batch has ended."""
_LOOK_S = 0.5
"""How often a worker looks whether its run has ended without a word."""
_HEAVY = (
    "photonpano.api.batch.running",
    "matplotlib.figure",
    "matplotlib.backends.backend_svg",
    "scipy.optimize",
    "skimage.metrics",
)
"""What runs import anyway."""


def main() -> NoReturn:
    """Work until the connection, whose number is the first argument, is closed."""
    for each in (signal.SIGINT, signal.SIGHUP):  # a terminal sends them to all; the batch decides what ends
        signal.signal(each, signal.SIG_IGN)
    batch = Connection(int(sys.argv[1]))
    os.set_inheritable(batch.fileno(), False)
    if sys.platform != "darwin":  # where libraries of the system do not survive a fork once they are loaded
        _load()
    from photonpano.registry import discover

    catalog = discover()
    while True:
        try:
            job: Job = batch.recv()
            batch.send(_row_of(job, batch, catalog))
        except (EOFError, OSError):
            os._exit(0)  # at once: to unload the libraries takes a second


def _load() -> None:
    """Load what all runs need: the libraries, and the machinery of compiled loops."""
    import numpy as np

    from photonpano.photometry import packed_counts

    for each in _HEAVY:
        importlib.import_module(each)
    packed_counts(np.zeros((8, 1, 1), np.uint8), 8)


def _row_of(job: Job, batch: Connection, catalog: Catalog) -> BatchRow:
    """Do a job in a process of its own.

    Raises:
        EOFError: the batch has ended meanwhile, and so has the run.
    """
    answers, answer = Pipe(duplex=False)
    life, lifeline = os.pipe()
    with tempfile.TemporaryFile() as printed:
        process = os.fork()
        if not process:
            batch.close()
            answers.close()
            os.close(lifeline)
            _work(job, answer, life, printed, catalog)
        answer.close()
        os.close(life)
        try:
            row, status = _awaited(process, answers, batch)
        except EOFError:
            os.close(lifeline)
            _end(process)
            raise
        os.close(lifeline)
        answers.close()
        return row or replace(job.row, status="failed", reason=_how_it_ended(status, printed))


def _work(job: Job, answer: Connection, life: int, printed: IO[bytes], catalog: Catalog) -> NoReturn:
    """Do a job, answer with its row, and end."""
    try:
        os.dup2(printed.fileno(), 1)
        os.dup2(printed.fileno(), 2)
        threading.Thread(target=_end_with, args=(life,), daemon=True).start()
        from photonpano.api.batch.running import run_job

        answer.send(run_job(job, catalog))
        code = 0
    except BaseException:
        import traceback

        traceback.print_exc()
        sys.stderr.flush()
        code = 1
    os._exit(code)  # whatever threads a plugin has left


def _end_with(life: int) -> NoReturn:
    """End this process when the worker has ended, and leave no unfinished file."""
    from photonpano.atomic import discard_unfinished

    os.read(life, 1)
    discard_unfinished()
    os._exit(1)


def _awaited(process: int, answers: Connection, batch: Connection) -> tuple[BatchRow | None, int]:
    """Wait until a process has ended; return its answer, if it gave one, and its status.

    Raises:
        EOFError: the batch has ended.
    """
    row = None
    while True:
        # A process that a plugin has started may hold the connection open when the run has ended.
        ready = wait([answers, batch], _LOOK_S)
        if batch in ready:
            raise EOFError
        if answers in ready:
            with suppress(EOFError):
                row = answers.recv()
            return row, os.waitpid(process, 0)[1]
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return row, status


def _end(process: int) -> None:
    """Wait until a process whose lifeline is cut has ended, and kill it if it does not: C code may hold its interpreter."""
    last = time.monotonic() + _GRACE_S
    while time.monotonic() < last:
        if os.waitpid(process, os.WNOHANG)[0]:
            return
        time.sleep(0.01)
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)


def _how_it_ended(status: int, printed: IO[bytes]) -> str:
    """Say how a process has ended that gave no answer."""
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGKILL:
        return (
            "the run was killed (SIGKILL), as the system does when memory runs out; lower run.memory or the number of jobs, "
            "or close other programs"
        )
    printed.seek(max(0, printed.seek(0, os.SEEK_END) - 2000))
    last = next(filter(None, reversed(printed.read().decode(errors="replace").splitlines())), "")
    how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended with the exit code {code}"
    return f"the run {how}{f': {last}' if last else ''}; a library or a plugin is to blame, or whoever sent the signal"
