"""Give the jobs of a batch to workers, and collect their rows."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection, wait

from photonpano.api.batch.job import Job
from photonpano.record.batch_row import BatchRow

_PROGRAM = "import sys, json; sys.path[:] = json.loads(sys.argv.pop()); from photonpano.api.batch.worker import main; main()"
_END_S = 0.8
"""How long workers may take to end their runs and themselves."""
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""For the libraries that a worker imports: runs keep them to one thread anyway, and a process with threads cannot be forked."""


class Worker:
    """A process that does one job after another; each run is a process of its own."""

    def __init__(self) -> None:
        mine, its = socket.socketpair()
        with its:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM, str(its.fileno()), json.dumps(sys.path)],
                pass_fds=[its.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env=os.environ | _ONE_THREAD,
            )
        self.connection = Connection(mine.detach())

    def start(self, job: Job) -> None:
        """Start a job. The row is read from the `connection`."""
        with suppress(OSError):  # a worker that has died is found when its row is read
            self.connection.send(job)

    def row(self, job: Job) -> tuple[BatchRow, bool]:
        """Return the row of the job that was started, and whether the worker is still there."""
        try:
            row: BatchRow = self.connection.recv()
            return row, True
        except (EOFError, OSError):
            self.connection.close()
            code = self._process.wait()
            how = f"killed ({signal.Signals(-code).name})" if code < 0 else f"ended with the exit code {code}"
            return replace(job.row, status="failed", reason=f"the process that was to run it was {how}"), False

    def leave(self) -> None:
        """Close the connection, which ends the worker and its run."""
        self.connection.close()

    def end(self) -> None:
        """Wait for the end of a worker that was left."""
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def rows_of(jobs: Sequence[Job], n_workers: int) -> Generator[list[tuple[int, BatchRow]], None, None]:
    """Do jobs, in their order, and yield the rows that have changed with their indices: those that begin, and those that end.

    When the generator is closed, or its caller is interrupted, the runs that are going on are ended.

    Args:
        jobs: what to do.
        n_workers: how many runs go on at once.
    """
    waiting = iter(enumerate(jobs))
    working: dict[Connection, tuple[Worker, int]] = {}
    idle: list[Worker] = []
    try:
        changed: list[tuple[int, BatchRow]] = []
        while True:
            while len(working) < n_workers and (following := next(waiting, None)) is not None:
                index, job = following
                worker = idle.pop() if idle else Worker()
                working[worker.connection] = worker, index
                worker.start(job)
                changed.append((index, replace(job.row, status="running")))
            yield changed
            if not working:
                return
            changed = []
            ready = wait(list(working))
            for connection in [each for each in working if each in ready]:
                worker, index = working.pop(connection)
                row, is_there = worker.row(jobs[index])
                changed.append((index, row))
                if is_there:
                    idle.append(worker)
    finally:
        workers = [*idle, *(worker for worker, _ in working.values())]
        for worker in workers:
            worker.leave()
        for worker in workers:
            worker.end()
