from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import parse_spec
from photonpano.captures.fingerprint import CaptureRecord, changes, fingerprint
from photonpano.pipeline.components import open_source

FRAMES = np.random.default_rng(0).integers(0, 256, (200, 16, 3), np.uint8)


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    np.save(tmp_path / "cube.npy", FRAMES)
    return tmp_path / "cube.npy"


def fingerprint_of(cube: Path, **changed: Any) -> CaptureRecord:
    source = {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 1000}}
    plan = parse_spec({"version": 1, "source": source, "corrections": [], **changed})
    with open_source(plan) as opened:
        return fingerprint(plan, opened)


def test_fingerprint_names_the_file_with_its_size_and_time(cube: Path) -> None:
    os.utime(cube, ns=(0, 1_000_000_007))
    assert fingerprint_of(cube)["files"] == [
        {"path": str(cube), "bytes": cube.stat().st_size, "modified": "1970-01-01T00:00:01.000000007Z", "etag": None}
    ]
    assert changes(fingerprint_of(cube), fingerprint_of(cube)) == []


def test_changes_name_a_touched_file(cube: Path) -> None:
    before = fingerprint_of(cube)
    os.utime(cube, ns=(0, 5))
    (change,) = changes(before, fingerprint_of(cube))
    assert change == f"{cube} was written at 1970-01-01T00:00:00.000000005Z, not {before['files'][0]['modified']}"


def test_changes_name_other_frames_of_the_same_size_and_time(cube: Path) -> None:
    before, stat = fingerprint_of(cube), cube.stat()
    np.save(cube, FRAMES[::-1])
    os.utime(cube, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert changes(before, fingerprint_of(cube)) == ["the frames are others"]


def test_changes_name_another_mask(cube: Path, tmp_path: Path) -> None:
    mask = tmp_path / "mask.npy"
    np.save(mask, np.zeros((16, 24), bool))
    corrections = [{"mask": {"file": str(mask)}}]
    before, stat = fingerprint_of(cube, corrections=corrections), mask.stat()
    np.save(mask, np.eye(16, 24) == 1)
    os.utime(mask, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    after = fingerprint_of(cube, corrections=corrections)
    assert changes(before, after) == ["the mask or another correction gives other pixels"]
    assert changes(fingerprint_of(cube), before) == [f"{mask} is read as well"]


def test_fingerprint_of_a_folder_leaves_out_runs_in_it(tmp_path: Path) -> None:
    for index in range(2):
        (tmp_path / f"RAW{index:05}.bin").write_bytes(bytes(512 * 512 // 8 * 64))
    plan_of = {"version": 1, "source": {"use": "spad512", "with": {"path": str(tmp_path)}}, "corrections": []}
    plan = parse_spec(plan_of)
    with open_source(plan) as source:
        before = fingerprint(plan, source)
        (tmp_path / "runs" / "scan").mkdir(parents=True)
        for name in ("run.json", "big.bin"):
            (tmp_path / "runs" / "scan" / name).write_bytes(b"content")
        (tmp_path / "notes.txt").write_text("a note")
        assert changes(before, fingerprint(plan, source)) == []
        (tmp_path / "more.bin").write_bytes(b"content")
        assert changes(before, fingerprint(plan, source)) == [f"{tmp_path} has another size"]


def test_fingerprint_of_a_simulation_has_frames_only() -> None:
    settings = {"n_frames": 20, "frame_shape": [16, 24]}
    plan = parse_spec({"version": 1, "source": {"use": "simulator", "with": settings}, "corrections": []})
    with open_source(plan) as source:
        found = fingerprint(plan, source)
    assert found["files"] == []
    assert len(found["frames_sha256"]) == 64
