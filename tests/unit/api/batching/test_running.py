"""Jobs of a batch: one in this process, and those in processes of their own, however they end."""

import importlib
import pickle
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from photonpano import BatchRow, Location
from photonpano.api import batch_running as running
from photonpano.api.batch_jobs import Job, SpecText, capture_override
from photonpano.api.batch_running import rows_of, run_job
from photonpano.pipeline.run import RunResult

MODULE = """\
import os, signal
from dataclasses import dataclass, field
from pathlib import Path
from photonpano.api.batch_jobs import Job
from photonpano.api.batch_jobs import SpecText
from photonpano.files.folders import atomic_path
from photonpano.record.batch_row import BatchRow

@dataclass(frozen=True)
class Odd(SpecText):
    ending: str = ""

    def plan(self, overrides, output, catalog=None):
        if self.ending:
            print("printed by a library", flush=True)
            with atomic_path(Path(f"{output}.file")):
                exec(self.ending)
        return super().plan(overrides, output, catalog)

def job(ending, folder, spec=""):
    name = f"job-{abs(hash(ending))}"
    row = BatchRow(name, folder / "absent.npy", {}, folder / name)
    return Job(row, Odd(spec or "version: 1", folder, None, ending), (), 1)
"""


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module that processes import: `odd.job(ending, folder)` is a job that runs a line of Python."""
    (tmp_path / "odd_jobs.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("odd_jobs")
    del sys.modules["odd_jobs"]


SPEC = {"version": 1, "source": {"use": "auto"}, "resample": {"with": {"group_size": 25}}, "levels": 1, "refine": []}


@pytest.fixture(scope="module")
def scan(simulated: Callable[..., Path]) -> Path:
    """A capture of 200 frames of 64x96 px, with its truth."""
    return simulated(n_frames=200, frame_shape=[64, 96])


@pytest.fixture
def job_of(tmp_path: Path) -> Callable[[Location], Job]:
    def job_of(capture: Location) -> Job:
        row = BatchRow("cube", capture, {}, tmp_path / "out" / "cube")
        return Job(row, SpecText(SPEC, tmp_path), (capture_override(capture),), 1)

    return job_of


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Let runs have a result, or an error, without running."""

    def found(result: Any) -> None:
        def run(plan: Any, *_: Any, **options: Any) -> Any:
            if isinstance(result, Exception):
                raise result
            return result

        monkeypatch.setattr(running, "run", run)

    return found


def test_run_is_scored_and_not_repeated(job_of: Callable[[Location], Job], scan: Path) -> None:
    job = pickle.loads(pickle.dumps(job_of(scan)))
    row = run_job(job)
    assert (row.status, row.was_finished, row.n_frames) == ("done", False, 200), row.reason
    assert row.report == job.row.directory / "report.html"
    assert row.verdict in ("trusted", "doubtful")
    assert 0 < row.true_error_px < 1
    assert 0 < row.expected_error_px < 1
    assert row.psnr_db > 10
    assert row.thumbnail.startswith("data:image/jpeg;base64,")
    again = run_job(job)
    assert (again.was_finished, again.true_error_px, again.seconds) == (True, row.true_error_px, row.seconds)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "there is no file or folder {path}; check the path"),
        (b"", "no source recognises {path}, a file of 0 bytes"),
        (b"a text, and no capture\n", "no source recognises {path}, a file of 23 bytes"),
        ("cut", "{path} is cut short: its header (200, 64, 12) promises 153728 bytes, the file has 76864"),
        ("black", "source: no pixel is lit in any of 200 frames"),
    ],
    ids=["absent", "empty", "text", "cut short", "black"],
)
def test_capture_that_cannot_be_used_says_why(
    job_of: Callable[[Location], Job], tmp_path: Path, content: bytes | str | None, reason: str
) -> None:
    path = tmp_path / "cube.npy"
    if isinstance(content, str):
        np.save(path, np.zeros((200, 64, 12), np.uint8))
        path.write_bytes(path.read_bytes()[: 76864 if content == "cut" else None])
    elif content is not None:
        path.write_bytes(content)
    row = run_job(job_of(path))
    assert row.status == "failed"
    assert row.reason.startswith(reason.format(path=path)), row.reason
    assert not row.directory.exists()


def test_run_without_a_usable_truth_is_done(
    job_of: Callable[[Location], Job], small_capture: Path, small_run: RunResult, found: Callable[[Any], None], tmp_path: Path
) -> None:
    found(small_run)
    capture = tmp_path / "cube.npy"
    capture.symlink_to(small_capture)
    assert run_job(job_of(capture)).true_error_px is None
    (tmp_path / "cube.truth.npz").write_bytes(b"")
    row = run_job(job_of(capture))
    assert (row.status, row.true_error_px) == ("done", None)
    assert row.reason.splitlines()[-1].startswith("no score: ")


def test_each_way_to_end_is_a_row(odd: ModuleType, tmp_path: Path) -> None:
    ways = {
        "os.kill(os.getpid(), signal.SIGKILL)": r"the run was killed \(SIGKILL\), as the system does when memory runs out; .*",
        "os._exit(3)": r"the run ended with the exit code 3: printed by a library; .*",
        "raise ValueError('odd')": r"ValueError: odd \(a defect of photonpano or of a plugin\)",
        "": r"1:1: source\.use: required: .*",
    }
    changes = list(rows_of([odd.job(way, tmp_path) for way in ways], 1))
    ended = {index: row for changed in changes for index, row in changed if row.status != "running"}
    assert [row.status for row in ended.values()] == ["failed"] * len(ways)
    for index, reason in enumerate(ways.values()):
        assert re.fullmatch(reason, ended[index].reason.splitlines()[0]), ended[index].reason
    assert [len(changed) for changed in changes] == [1, *[2] * (len(ways) - 1), 1]
