"""Kill runs, fill disks, race runs for one folder, and resume killed runs; count what is neither old, nor none, nor new.

    python tests/benchmarks/crashes.py kills --number 100 --seed 0
    python tests/benchmarks/crashes.py disks --number 20
    python tests/benchmarks/crashes.py races --number 50 --at-once 2
    python tests/benchmarks/crashes.py resumes --number 100 --writing 30

Every trial works on a simulated capture of 48x64 px in a temporary folder. `disks` mounts file systems in memory, which takes
the rights of root; without them, it limits the size of files only. `resumes` compares the results of killed and resumed runs
with those of an unbroken run: `--writing` of its runs die in the middle of writing a file of the work folder, of which a part
is left, the others at random moments, and a quarter of these twice; everything that is found is written at once there, so that
a kill may fall between any two results. The exit code is 1 if a trial fails.
"""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from harness import command, in_child, passing, simulator

from photonpano import load_spec, parse_spec, run, simulate
from photonpano.api.cli import main as program
from photonpano.pipeline.checkpoints.work_folder import SUFFIX
from photonpano.record import contents

SPEC = """version: 1
source: {{use: packed-npy, with: {{path: cube.npy, frame_rate_hz: 96800}}}}
resample: {{use: midpoint, with: {{group_size: 50}}}}
corrections: []
levels: 1
refine: []
run: {{seed: {seed}, threads: 1}}
output: {{directory: runs/scan}}
"""
RESULTS = ("trajectory.npz", "panorama.tiff", "coverage.tiff")
_CHANGES = ("os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.link", "shutil.rmtree")
"""What a process tells its audit hooks before the system changes names of files."""


class Run:
    """A run in a process of its own, which is forked so that it need not import anything.

    Args:
        folder: the current folder of the process.
        options: of `photonpano run`.
        dies: called in the process before the run begins: it sees to its death.
    """

    def __init__(self, folder: Path, *options: str, dies: Callable[[], object] = lambda: None) -> None:
        self._printed = tempfile.TemporaryFile("w+")  # noqa: SIM115  # closed with the object
        self._process = get_context("fork").Process(target=self._work, args=(folder, options, dies))
        self._process.start()

    def _work(self, folder: Path, options: tuple[str, ...], dies: Callable[[], object]) -> None:
        os.chdir(folder)
        for stream in (1, 2):
            os.dup2(self._printed.fileno(), stream)
        sys.argv = ["photonpano", "run", "scan.yaml", *options]
        dies()
        program()

    def kill_after(self, seconds: float) -> None:
        """Kill the process after a time, unless it ends before."""
        self._process.join(seconds)
        self._process.kill()

    def wait(self) -> str:
        """Wait for the end, and return what was printed."""
        self._process.join()
        self._printed.seek(0)
        return self._printed.read()

    @property
    def code(self) -> int | None:
        """The exit code of the process, negative of a signal."""
        return self._process.exitcode


def dying_at_change(number: int) -> None:
    """Have this process kill itself at the change of a file of this number, of those that matter."""
    left = number

    def count(event: str, args: tuple[Any, ...]) -> None:
        nonlocal left
        written = event == "open" and isinstance(args[1], str) and set(args[1]) & set("wax+") and "runs" in str(args[0])
        if event in _CHANGES or written:
            left -= 1
            if not left:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(count)


def dying_in_file(number: int, part: float) -> None:
    """Have this process kill itself in the record of this number, of which only a part reaches the disk."""
    write, left = Path.write_bytes, number

    def dying(path: Path, content: bytes) -> int:
        nonlocal left
        left -= path.suffix == SUFFIX
        if not left:
            write(path, content[: int(part * len(content))])
            os.kill(os.getpid(), signal.SIGKILL)
        return write(path, content)

    mock.patch.object(Path, "write_bytes", dying).start()


def prepare(folder: Path) -> None:
    """Simulate the capture, and write the spec."""
    capture = simulator(n_frames=200, frame_shape=[48, 64], path={"kind": "pan", "length_px": 16}, flux=0.5)
    simulate(parse_spec(capture), folder / "cube.npy")
    write_spec(folder, 0)


def write_spec(folder: Path, seed: int) -> None:
    """Write the spec; its seed distinguishes the runs."""
    (folder / "scan.yaml").write_text(SPEC.format(seed=seed))


def state(folder: Path) -> tuple[int | None, list[str]]:
    """Return the seed of the run that the folder holds, None if there is none; and what is wrong with it."""
    directory = folder / "runs" / "scan"
    if not directory.exists():
        return None, []
    changed = contents.changed_files(directory)
    if changed is None:
        return None, ["run.json is missing or lists nothing"]
    record = json.loads((directory / "run.json").read_text())
    missing = [name for name in record["files"] if not (directory / name).exists()]
    other = sorted({path.name for path in directory.iterdir()} - {*record["files"], "run.json", "report.html"})
    lacking = sorted(
        contents.RESULTS - {"report.html", "run.json", "light.npz", "layers.npz", "vignette.npz", *record["files"]}
    )
    return record["seed"], [*changed, *missing, *(f"more: {name}" for name in other), *(f"lacks {name}" for name in lacking)]


def leftovers(folder: Path) -> list[str]:
    """Return what is in the folder beside capture, spec and run."""
    beside = {path.name for path in folder.iterdir()} - {"cube.npy", "cube.truth.npz", "scan.yaml", "runs"}
    inside = {path.name for path in (folder / "runs").iterdir()} - {"scan"} if (folder / "runs").exists() else set()
    return sorted(beside | inside)


def duration_s(folder: Path, *options: str) -> float:
    """Return how long an unbroken run takes, which need not compile."""
    Run(folder, *options).wait()
    start = time.perf_counter()
    Run(folder, *options).wait()
    return time.perf_counter() - start


def kills(folder: Path, number: int, seed: int) -> list[str]:
    """Kill runs at random moments, a third of them while they write, and run again after each tenth."""
    rng, wrong, writing, counts = random.Random(seed), [], 0, Counter[str]()
    whole_s, old = duration_s(folder), 0
    for index in range(1, number + 1):
        write_spec(folder, index)
        if index % 3 == 0:
            process = Run(folder, dies=partial(dying_at_change, rng.randint(1, 60)))
        else:
            process = Run(folder)
            process.kill_after(rng.uniform(0, whole_s))
        process.wait()
        writing += index % 3 == 0 and process.code == -signal.SIGKILL
        found, problems = state(folder)
        counts["no run" if found is None else "the new run" if found == index else "the old run"] += 1
        if problems or found not in (None, old, index):
            wrong.append(f"kill {index}: seed {found} after {old}; {problems}")
        old = old if found is None else found  # the next run puts it back
        print(f"kill {index}: {process.code}, seed {found} {problems or ''}", file=sys.stderr)
        if index % 10 == 0:
            printed = Run(folder).wait()
            found, problems = state(folder)
            if found != index or problems or leftovers(folder):
                wrong.append(f"run after kill {index}: seed {found}, {problems}, left {leftovers(folder)}: {printed}")
            old = found
    states = ", ".join(f"{count} left {state}" for state, count in counts.items())
    print(f"{number} kills, {writing} of them while writing: {states}, {len(wrong)} failed")
    return wrong


def disks(folder: Path, number: int, seed: int) -> list[str]:
    """Run on disks of many sizes, and with limits of the size of files; go on where there is room."""
    del seed
    wrong: list[str] = []
    for way in (_disk, _limit):
        counts = Counter[int | None]()
        sizes = sorted({int(4096 * 256 ** (index / max(number - 1, 1))) for index in range(number)})
        write_spec(folder, 0)
        Run(folder).wait()
        for index, size in enumerate(sizes, start=1):
            write_spec(folder, index)
            with way(folder / "runs", size) as dies:
                process = Run(folder, dies=dies)
                printed = process.wait()
                found, problems = state(folder)
            counts[process.code] += 1
            left = set(leftovers(folder)) - ({"scan.work"} if process.code else set())
            if process.code not in (0, 1) or found != index - process.code or problems or left or "Trace" in printed:
                wrong.append(f"{size} bytes: exit {process.code}, seed {found}, {problems}, left {left}: {printed}")
            process = Run(folder, "--resume")
            printed = process.wait()
            found, problems = state(folder)
            if process.code or found != index or problems or leftovers(folder):
                wrong.append(f"after {size} bytes: exit {process.code}, {problems}, left {leftovers(folder)}: {printed}")
        title = "disks with room for" if way is _disk else "limits of files of"
        fitted = f"{counts[0]} runs fitted, {counts[1]} were refused with a sentence"
        print(f"{title} {sizes[0]} to {sizes[-1]} bytes: {fitted}", flush=True)
    print(f"{len(wrong)} failed")
    return wrong


@contextmanager
def _disk(runs: Path, room: int) -> Iterator[Callable[[], object]]:
    """Move the run folder to a file system in memory that has room for some bytes more; afterwards move it back."""
    with tempfile.TemporaryDirectory() as kept:
        shutil.copytree(runs, kept, dirs_exist_ok=True)
        mounted = ["mount", "-t", "tmpfs", "-o", f"size={64 * 2**20}", "none", runs]
        if subprocess.run(mounted, capture_output=True, check=False).returncode:
            raise SystemExit("a file system cannot be mounted: only root can")
        try:
            shutil.copytree(kept, runs, dirs_exist_ok=True)
            disk = os.statvfs(runs)
            used = (disk.f_blocks - disk.f_bfree) * disk.f_frsize
            subprocess.run(["mount", "-o", f"remount,size={used + room}", runs], check=True)
            yield lambda: None
            shutil.rmtree(kept)
            shutil.copytree(runs, kept)
        finally:
            subprocess.run(["umount", runs], check=True)
        shutil.rmtree(runs)
        shutil.copytree(kept, runs)


@contextmanager
def _limit(runs: Path, room: int) -> Iterator[Callable[[], object]]:
    """Limit the size of files."""
    del runs
    yield partial(resource.setrlimit, resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))


def races(folder: Path, number: int, seed: int, at_once: int = 2) -> list[str]:
    """Start runs into one folder at once."""
    del seed
    wrong = []
    for index in range(number):
        processes = [Run(folder, "--set", f"run.seed={each}") for each in range(at_once)]
        errors = [process.wait() for process in processes]
        done = [each for each, process in enumerate(processes) if process.code == 0]
        refused = [error for process, error in zip(processes, errors, strict=True) if process.code == 1]
        found, problems = state(folder)
        if problems or found not in done or not done or not all("is in use: " in error for error in refused):
            wrong.append(f"race {index}: seed {found} of {done}, {problems}, {refused}")
        if leftovers(folder):
            wrong.append(f"race {index}: left {leftovers(folder)}")
    print(f"{number} races of {at_once}: {len(wrong)} failed")
    return wrong


def resumes(folder: Path, number: int, seed: int, writing: int) -> list[str]:
    """Kill runs, resume them until they are finished, and compare their results with those of an unbroken run."""
    rng = np.random.default_rng(seed)
    levels = ("--set", "levels=2", "--set", "resample.with.group_size=20", "--set", "refine=short-spans")
    whole_s, n_killed, wrong = duration_s(folder, *levels), 0, []

    def results() -> list[bytes]:
        return [(folder / "runs" / "scan" / name).read_bytes() for name in RESULTS]

    expected = results()
    for index in range(number):
        shutil.rmtree(folder / "runs" / "scan")
        if index < writing:
            killed = [Run(folder, "--resume", *levels, dies=partial(dying_in_file, rng.integers(1, 35), rng.uniform()))]
            killed[0].wait()
        else:
            killed = []
            for moment in rng.uniform(0, whole_s, 2 if index % 4 == 0 else 1):
                killed.append(Run(folder, "--resume", *levels))
                killed[-1].kill_after(moment)
                killed[-1].wait()
        n_killed += sum(process.code == -signal.SIGKILL for process in killed)
        printed = Run(folder, "--resume", *levels).wait()
        if any(process.code not in (0, -signal.SIGKILL) for process in killed):
            wrong.append(f"run {index} failed by itself: {printed}")
        elif results() != expected or leftovers(folder):
            wrong.append(f"run {index}: the same bytes: {results() == expected}, left {leftovers(folder)}: {printed}")
    same = f"{number - len(wrong)} of {number} runs ended with the same bytes and left nothing behind"
    print(f"{same}; {n_killed} kills hit a run; an unbroken run takes {whole_s:.2f} s")
    return wrong


TRIALS = {"kills": kills, "disks": disks, "races": races, "resumes": resumes}


def main(trial: Path, number: int = 20, seed: int = 0, at_once: int = 2, writing: int = 6) -> bool:
    """Run one trial."""
    if str(trial) not in TRIALS:
        raise SystemExit(f"no trial is called {trial}; there are {', '.join(TRIALS)}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")
    # Drawing takes longer than the rest of such a run; the files matter here.
    drawn = mock.patch("photonpano.pipeline.run.render_report", return_value="<html>" + 200_000 * " ")
    with passing() as study, drawn:
        in_child(prepare, study.folder)  # a forked process keeps the locks of threads that it has not got
        run(load_spec(study.folder / "scan.yaml"))  # so that those forked from this process find the machine code loaded
        more = {"races": {"at_once": at_once}, "resumes": {"writing": writing}}.get(str(trial), {})
        if "writing" in more:
            mock.patch("photonpano.pipeline.checkpoints.work_folder.FLUSH_S", 0.0).start()
        wrong = TRIALS[str(trial)](study.folder, number, seed, **more)
    print(*wrong, sep="\n")
    return bool(wrong)


if __name__ == "__main__":
    command(main)
