"""Kill runs at random moments, resume them, and compare their results with those of an unbroken run.

    python tests/benchmarks/kills.py [--moments 100] [--writing 30] [--seed 0]

`--writing` of the moments are in the middle of writing a file of the work folder, of which a part is left. A quarter of the
runs is killed twice. The captures are small, and everything that is found is written at once, so that a kill may fall between
any two results. The script exits with 1 if one result differs, or something is left behind.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from photonpano import parse_spec, run, simulate

FILES = ("trajectory.npz", "panorama.tiff", "coverage.tiff")
CAPTURE = {
    "scene": {"kind": "street", "width": 512, "height": 400},
    "path": {"kind": "pan", "length_px": 24, "shake": {"rms_px": 1, "frequencies_hz": [600, 1500]}},
    "n_frames": 160,
    "frame_shape": [48, 64],
}


@dataclass(frozen=True)
class Trial:
    """A run that was killed and resumed.

    Attributes:
        moments: when it was killed, in seconds or at the number of a file.
        killed: how often it was killed before it was finished.
        same: whether its results are those of the unbroken run.
        left: what it left behind beside the run folder.
    """

    moments: tuple[str, ...]
    killed: int
    same: bool
    left: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether the run ended as if nothing had happened."""
        return self.same and not self.left


class Kills:
    """Runs of one capture that are killed.

    Args:
        folder: for the capture and the runs.
        seed: of the moments.
    """

    def __init__(self, folder: Path, seed: int) -> None:
        self._folder, self._rng = folder, np.random.default_rng(seed)
        source: dict[str, Any] = {"use": "simulator", "with": CAPTURE}
        simulate(parse_spec({"version": 1, "source": source}), folder / "cube.npy")
        self.run("unbroken")  # compiles, so that the next one takes as long as the others
        start = time.perf_counter()
        self.run("unbroken")
        self.duration_s = time.perf_counter() - start
        self._expected = self._results("unbroken")

    def run(self, name: str, resume: bool = False) -> None:
        """Run the capture, without the report, which no result depends on."""
        spec: dict[str, Any] = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(self._folder / "cube.npy"), "frame_rate_hz": 96_800}},
            "corrections": [],
            "resample": {"use": "midpoint", "with": {"group_size": 20}},
            "levels": 2,
        }
        plan = parse_spec(spec, output=self._folder / "runs" / name)
        with (
            mock.patch("photonpano.pipeline.run.render_report", return_value=""),
            mock.patch("photonpano.pipeline.checkpoints.store.FLUSH_S", 0.0),
        ):
            run(plan, resume=resume)

    def at_a_moment(self, number: int) -> Trial:
        """Kill a run after some time, and resume it until it is finished."""
        moments = self._rng.uniform(0, self.duration_s, 2 if number % 4 == 0 else 1)
        killed = sum(self._killed(number, lambda: self.run(f"{number}", resume=True), after_s=float(each)) for each in moments)
        return self._trial(number, tuple(f"{each:.2f} s" for each in moments), killed)

    def while_writing(self, number: int) -> Trial:
        """Kill a run in the middle of writing a file, and resume it."""
        file, part = int(self._rng.integers(1, 35)), float(self._rng.uniform())

        def die() -> None:
            with _dying_at(file, part):
                self.run(f"{number}", resume=True)

        return self._trial(number, (f"file {file}",), self._killed(number, die))

    def _killed(self, number: int, work: Callable[[], None], after_s: float | None = None) -> bool:
        """Do some work in a process of its own, and kill that; return whether it was killed before the end."""
        child = os.fork()
        if child == 0:
            code = 1
            try:
                work()
                code = 0
            finally:
                os._exit(code)
        if after_s is not None:
            time.sleep(after_s)
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status) and os.WEXITSTATUS(status):
            raise RuntimeError(f"run {number} failed by itself")
        return os.WIFSIGNALED(status)

    def _trial(self, number: int, moments: tuple[str, ...], killed: int) -> Trial:
        self._killed(number, lambda: self.run(f"{number}", resume=True))
        beside = [path.name for path in (self._folder / "runs").iterdir()]
        left = tuple(sorted(name for name in beside if name.startswith((f"{number}.", "."))))
        return Trial(moments, killed, self._results(f"{number}") == self._expected, left)

    def _results(self, name: str) -> list[bytes]:
        return [(self._folder / "runs" / name / file).read_bytes() for file in FILES]


@contextmanager
def _dying_at(number: int, part: float) -> Iterator[None]:
    """Kill this process when the file of this number was written, after only a part of it has reached the disk."""
    write, written = np.savez, 0

    def dying(path: Any, **arrays: Any) -> None:
        nonlocal written
        write(path, **arrays)
        written += 1
        if written == number:
            os.truncate(path, int(part * Path(path).stat().st_size))
            os.kill(os.getpid(), signal.SIGKILL)

    with mock.patch("numpy.savez", dying):
        yield


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moments", type=int, default=100)
    parser.add_argument("--writing", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        kills = Kills(Path(folder), options.seed)
        print(f"an unbroken run takes {kills.duration_s:.2f} s")
        trials = []
        for number in range(options.moments):
            trial = kills.while_writing(number) if number < options.writing else kills.at_a_moment(number)
            trials.append(trial)
            if not trial.good or number % 10 == 9:
                print(number + 1, trial)
    n_good, n_killed = sum(trial.good for trial in trials), sum(trial.killed for trial in trials)
    print(f"{n_good} of {len(trials)} runs ended with the same bytes and left nothing behind; {n_killed} kills hit a run")
    return 0 if n_good == len(trials) else 1


if __name__ == "__main__":
    sys.exit(main())
