from __future__ import annotations

import fcntl
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from photonpano import InputError, clean, verify
from photonpano.pipeline.run import RunResult
from photonpano.reading.npy import unpacked


@pytest.fixture
def finished(small_run: RunResult, tmp_path: Path) -> Path:
    shutil.copytree(small_run.directory, tmp_path / "run")
    return tmp_path / "run"


def test_verify_accepts_a_finished_run(small_run: RunResult) -> None:
    found = verify(small_run.directory)
    assert (found.n_files, found.problems, found.capture) == (5, (), "the same frames")
    assert found.n_bytes == sum(path.stat().st_size for path in small_run.directory.iterdir() if path.name != "run.json")


def test_verify_finds_what_differs(finished: Path) -> None:
    (finished / "report.html").unlink()
    with (finished / "panorama.tiff").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x07")
    target = (finished / "trajectory.npz").rename(finished.parent / "elsewhere.npz")
    (finished / "trajectory.npz").symlink_to(target)
    record = json.loads((finished / "run.json").read_text())
    record["capture"]["frames_sha256"] = "0"
    (finished / "run.json").write_text(json.dumps(record))
    assert verify(finished).problems == (
        "report.html is missing",
        "panorama.tiff is not the file that the run wrote",
        "trajectory.npz is not the file that the run wrote",
        "the frames are others",
    )


def test_verify_says_what_it_cannot_compare(finished: Path) -> None:
    record = json.loads((finished / "run.json").read_text())
    record["spec"]["source"]["with"]["path"] = "/nowhere/cube.npy"
    (finished / "run.json").write_text(json.dumps(record))
    found = verify(finished)
    assert (found.problems, found.capture) == ((), "not compared: there is no file /nowhere/cube.npy; check the path")
    del record["files"]
    (finished / "run.json").write_text(json.dumps(record))
    assert verify(finished).problems == ("run.json lists no hashes, as in older versions",)


def test_clean_removes_leftovers_only(tmp_path: Path) -> None:
    import gzip

    with gzip.open(tmp_path / "cube.npy.gz", "wb") as file:
        np.save(file, np.zeros((4, 5, 6), np.uint8))
    shutil.copy(tmp_path / "cube.npy.gz", tmp_path / "used.npy.gz")
    (tmp_path / "cube.npy.gz.unpacked.npy").write_bytes(b"old")
    (tmp_path / "lost.npy.gz.unpacked.npy").write_bytes(b"its archive is gone")
    unpacked(tmp_path / "used.npy.gz")
    left = [".scan.0123abcd.partial/panorama.tiff", ".cube.0123abcd.partial.npy", ".scan.lock", "run/.0123abcd.partial/a"]
    kept = [".used.0123abcd.partial.npy", "cube.npy.part", ".mine.lock", ".partial", ".x.partial", "notes.partial", "run/.lock"]
    for name in (*left, *kept):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("content")
    (tmp_path / ".scan.lock").write_text(json.dumps({"host": "a", "pid": 1, "process_start": "", "since": ""}))
    (tmp_path / ".link.0123abcd.partial").symlink_to(tmp_path / "notes.partial")
    before = {path for path in tmp_path.rglob("*") if path.is_file() or path.is_symlink()}
    expected = sorted(
        tmp_path / name.removesuffix("/panorama.tiff").removesuffix("/a") for name in (*left, "cube.npy.gz.unpacked.npy")
    )
    with (tmp_path / ".used.0123abcd.partial.npy").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert sorted(clean(tmp_path, dry_run=True)) == expected
        assert {path for path in tmp_path.rglob("*") if path.is_file() or path.is_symlink()} == before
        assert sorted(clean(tmp_path)) == expected
    removed = before - {path for path in tmp_path.rglob("*") if path.is_file() or path.is_symlink()}
    assert removed == {tmp_path / name for name in (*left, "cube.npy.gz.unpacked.npy")}
    with pytest.raises(InputError) as caught:
        clean(tmp_path / "nowhere")
    assert str(caught.value) == f"there is no folder {tmp_path}/nowhere; check the path"


def test_clean_finishes_a_run_that_was_killed_in_its_step(finished: Path) -> None:
    pending = finished / ".photonpano-pending"
    pending.mkdir()
    for path in finished.glob("*.*"):
        if path.is_file():
            path.rename(pending / path.name)
    clean(finished.parent)
    assert not pending.exists()
    assert verify(finished).problems == ()
