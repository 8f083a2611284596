"""Runs and batches in processes of their own: killed and interrupted."""

from __future__ import annotations

import csv
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from photonpano import InputError, batch, load_spec, run
from photonpano.api.cli.app import app
from photonpano.capture.writing import truth_path

HEADLESS = "opencv-python-headless"
SPEC = {"version": 1, "source": {"use": "auto"}, "resample": {"with": {"group_size": 40}}, "levels": 1, "refine": []}
INTERRUPTED = """\
import sys, time
from pathlib import Path
sys.path[:] = {path}
import photonpano.api.batch
import hanging
photonpano.api.batch.SpecText = hanging.Hanging
from photonpano.api.cli import main
main()
"""
HANGING = """\
import time
from pathlib import Path
from photonpano.api.batch_jobs import SpecText
from photonpano.files.folders import staging_of

class Hanging(SpecText):
    def plan(self, overrides, output, catalog=None):
        if output.name == "b":
            with staging_of(output, "b"):
                (output.parent / "begun").touch()
                time.sleep(60)
        return super().plan(overrides, output, catalog)
"""


def copied(capture: Path, path: Path) -> Path:
    shutil.copy(capture, path)
    shutil.copy(truth_path(capture), truth_path(path))
    return path


def statuses(folder: Path) -> list[str]:
    with (folder / "summary.csv").open(encoding="utf-8") as file:
        return [row["status"] for row in csv.DictReader(file)]


def test_batch_runs_what_is_left(tiny_capture: Path, tmp_path: Path) -> None:
    copied(tiny_capture, tmp_path / "a.npy")
    (tmp_path / "empty.npy").touch()
    first = batch(SPEC, [tmp_path / "*.npy"], tmp_path / "out", jobs=2)
    assert [(row.name, row.status) for row in first.rows] == [("a", "done"), ("empty", "failed")]
    assert first.failed == first.rows[1:]
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"a", "summary.csv", "summary.html"}
    copied(tiny_capture, tmp_path / "empty.npy")
    again = batch(SPEC, [tmp_path / "*.npy"], tmp_path / "out")
    assert [(row.status, row.was_finished) for row in again.rows] == [("done", True), ("done", False)]
    assert [row.true_error_px for row in again.rows] == [first.rows[0].true_error_px] * 2
    results = [tmp_path / "out" / name / "trajectory.npz" for name in ("a", "empty")]
    assert results[0].read_bytes() == results[1].read_bytes()
    assert statuses(tmp_path / "out") == ["done"] * 2


def test_interrupted_batch_keeps_what_is_finished(tiny_capture: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        copied(tiny_capture, tmp_path / f"{name}.npy")
    (tmp_path / "hanging.py").write_text(HANGING, encoding="utf-8")
    (tmp_path / "scan.yaml").write_text(
        "{version: 1, source: {use: auto}, resample: {with: {group_size: 40}}, levels: 1, refine: []}", encoding="utf-8"
    )
    program = INTERRUPTED.format(path=[str(tmp_path), *sys.path])
    command = [sys.executable, "-c", program, "batch", "scan.yaml", "a.npy", "b.npy", "c.npy", "-o", "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    with subprocess.Popen(command, cwd=tmp_path, **pipes, **heed) as process:
        last = time.monotonic() + 60
        while not (tmp_path / "out" / "begun").exists() and process.poll() is None and time.monotonic() < last:
            time.sleep(0.05)
        time.sleep(0.3)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=10)
    assert process.returncode == 130, err
    assert "[1/3] a: " in err
    assert statuses(tmp_path / "out") == ["done", "interrupted", "interrupted"]
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"a", "begun", "summary.csv", "summary.html"}


def test_interrupted_run_says_how_to_go_on(tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("photonpano.pipeline.run.estimate", interrupted)
    result = CliRunner().invoke(app, ["run", str(tiny_capture), "--output", str(tmp_path / "run")])
    assert result.exit_code == 130
    assert result.stderr.endswith("under its final name; the same command with --resume goes on\n")


def test_another_opencv_is_refused(tiny_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "__version__", "4.11.0")
    monkeypatch.setattr("photonpano.pipeline.run.packages_distributions", lambda: {"cv2": ["opencv-python", HEADLESS]})
    remove = f"run `pip uninstall opencv-python {HEADLESS}` and then `pip install {HEADLESS}`"
    with pytest.raises(InputError, match=f"^OpenCV 4.11.0 of opencv-python is imported instead of {HEADLESS} 5.*: {remove}$"):
        run(load_spec(tiny_capture, output=tmp_path / "run"))
