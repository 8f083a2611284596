"""A run that crashes or is killed costs its row, and a batch that is killed leaves no process behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from photonpano.api.batching.processes import rows_of

BATCH = """\
import sys
from pathlib import Path
import odd_jobs
from photonpano.api.batching.processes import rows_of
jobs = [odd_jobs.job(ending, Path.cwd()) for ending in sys.argv[1:]]
for changed in rows_of(jobs, 1):
    print(changed, flush=True)
"""
HOLDING_INTERPRETER = "sum(itertools.repeat(0))"


def wait_for(condition: Callable[[], bool], seconds: float) -> bool:
    last = time.monotonic() + seconds
    while time.monotonic() < last and not condition():
        time.sleep(0.02)
    return condition()


def lives(process: int) -> bool:
    """Return whether a process lives; one that has ended and waits for its parent does not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def processes(folder: Path) -> list[int]:
    """Return the processes of the runs that have begun, and what they were forked from."""
    return [int(word) for file in folder.glob("*.pid") for word in file.read_text().split()]


def test_each_way_to_end_is_a_row(odd: ModuleType, tmp_path: Path) -> None:
    ways = {
        "os.kill(os.getpid(), signal.SIGKILL)": r"the run was killed \(SIGKILL\), as the system does when memory runs out; .*",
        "os.abort()": r"the run crashed \(SIGABRT\): printed by a library; a library or a plugin is to blame, .*",
        "os._exit(3)": r"the run ended with the exit code 3: printed by a library; .*",
        "raise KeyboardInterrupt": r"the run ended with the exit code 1: KeyboardInterrupt; .*",
        "raise ValueError('odd')": r"ValueError: odd \(a defect of photonpano or of a plugin\)",
        "raise MemoryError": r"there is not enough memory; lower run\.memory, or the number of jobs",
        "": r"1:1: source\.use: required: .*",
        "os.kill(os.getppid(), signal.SIGKILL); time.sleep(60)": r"the run ended with the exit code 255: .*",
    }
    changes = list(rows_of([odd.job(way, tmp_path) for way in ways], 1))
    ended = {index: row for changed in changes for index, row in changed if row.status != "running"}
    assert [row.status for row in ended.values()] == ["failed"] * len(ways)
    for index, reason in enumerate(ways.values()):
        assert re.fullmatch(reason, ended[index].reason.splitlines()[0]), ended[index].reason
    assert [len(changed) for changed in changes] == [1, *[2] * (len(ways) - 1), 1]
    assert wait_for(lambda: not any(map(lives, processes(tmp_path))), 5)


def test_killed_batch_leaves_no_process(odd: ModuleType, tmp_path: Path) -> None:
    script = [sys.executable, "-c", BATCH, HOLDING_INTERPRETER]
    with subprocess.Popen(script, cwd=tmp_path, stdout=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": path()}) as batch:
        assert wait_for(lambda: len(processes(tmp_path)) == 2, 60)
        time.sleep(0.1)
        assert all(map(lives, processes(tmp_path)))
        batch.send_signal(signal.SIGKILL)
    assert wait_for(lambda: not any(map(lives, processes(tmp_path))), 5)


def path() -> str:
    return os.pathsep.join(["", *filter(None, sys.path)])
