"""One job, in this process."""

from __future__ import annotations

import logging
import pickle
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import BatchRow, Location, LocationError, Url
from photonpano.api.batching import running
from photonpano.api.batching.running import run_job
from photonpano.api.batching.sweeps import Job, SpecText, capture_override
from photonpano.pipeline.run import RunResult

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


def test_run_is_scored_and_not_repeated(job_of: Callable[[Location], Job], scan: Path, without_report: None) -> None:
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


def test_capture_at_a_url_is_run_without_a_score(
    job_of: Callable[[Location], Job], scan: Path, file_server: Callable[..., Any], without_report: None
) -> None:
    with file_server(scan.parent) as server:
        job = job_of(Url(f"{server.address}/{scan.name}?key=secret"))
        row = run_job(job)
        assert (row.status, row.n_frames, row.true_error_px) == ("done", 200, None), row.reason
        assert run_job(job).was_finished
    assert str(row.capture) == f"{server.address}/{scan.name}"
    assert "secret" not in (row.directory / "run.json").read_text(encoding="utf-8")


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


def test_run_that_is_not_located_has_a_page(job_of: Callable[[Location], Job], tmp_path: Path, without_report: None) -> None:
    noise = np.random.default_rng(0).random((200, 64, 96)) < 0.01
    np.save(tmp_path / "cube.npy", np.packbits(noise, axis=-1))
    row = run_job(job_of(tmp_path / "cube.npy"))
    assert (row.status, row.report) == ("failed", tmp_path / "out" / "cube.failed.html")
    assert "could be located" in row.reason
    assert row.report.exists()


def test_error_and_warnings_of_a_run_are_its_reason(
    job_of: Callable[[Location], Job], found: Callable[[Any], None], small_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found(LocationError("none of the pairs could be located"))
    logger = logging.getLogger("photonpano.pipeline")
    plan = SpecText.plan
    monkeypatch.setattr(SpecText, "plan", lambda *arguments: (logger.warning("odd pixels"), plan(*arguments))[1])
    assert run_job(job_of(small_capture)).reason == "none of the pairs could be located\nwarning: odd pixels"


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


def test_poses_have_doubts_and_errors_of_positions(
    job_of: Callable[[Location], Job],
    small_capture: Path,
    small_run: RunResult,
    found: Callable[[Any], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    poses = {"std_position": 0.01, "doubts": ["the path is straight"]}
    found(RunResult(Path("nowhere"), small_run.record | {"poses": poses, "motion": None}, None))
    monkeypatch.setattr(running, "evaluate_poses", lambda *_: SimpleNamespace(ate_share=0.02))
    row = run_job(job_of(small_capture))
    assert (row.verdict, row.reason) == ("doubtful", "the path is straight")
    assert (row.expected_position_error, row.true_position_error) == (0.01, 0.02)
    assert (row.expected_error_px, row.true_error_px, row.thumbnail) == (None, None, None)
