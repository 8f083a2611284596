"""The files of a run folder, beside those of others."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photonpano.pipeline.run_folder import run_folder
from photonpano.record.contents import changed_files

from .small_results import FILES, FLUX, PANORAMA, PICTURE, RECORD, WRITERS, files_in, run_into, write_all


def test_run_folder_holds_the_written_files(tmp_path: Path) -> None:
    run_into(tmp_path / "runs" / "scan")
    directory = tmp_path / "runs" / "scan"
    assert set(files_in(directory)) == FILES
    np.testing.assert_array_equal(tifffile.imread(directory / "panorama.tiff"), FLUX)
    np.testing.assert_array_equal(tifffile.imread(directory / "coverage.tiff"), PANORAMA.weight)
    np.testing.assert_array_equal(cv2.imread(str(directory / "panorama.png"), cv2.IMREAD_UNCHANGED), PICTURE)
    with np.load(directory / "trajectory.npz") as archive:
        assert set(archive.files) == {
            "homographies",
            "canvas",
            "projection",
            "horizon",
            "frame_shape",
            "reference",
            "located",
            "std_px",
        }
        assert tuple(archive["frame_shape"]) == (48, 64)
    record = json.loads((directory / "run.json").read_text())
    assert record["warnings"] == ["a line"] * 2000
    assert set(record["files"]) == FILES - {"run.json"}
    assert record["files"]["panorama.png"] == {
        "bytes": (directory / "panorama.png").stat().st_size,
        "sha256": hashlib.sha256((directory / "panorama.png").read_bytes()).hexdigest(),
    }
    assert changed_files(directory) == []
    assert (directory / "report.html").read_text(encoding="utf-8").startswith("<html>µ</html>")
    assert list((tmp_path / "runs").iterdir()) == [directory]


def test_run_folder_changes_in_one_step_and_keeps_other_files(old: Path, system: str) -> None:
    before = files_in(old)
    with run_folder(old, overwrite=True) as folder:
        for write in WRITERS[:-1]:
            write(folder)
        assert files_in(old) == before
        folder.commit(RECORD)
        after = files_in(old)
        assert set(after) == (FILES - {"report.html"}) | {"notes/a.txt"}
        assert after["notes/a.txt"] == b"a note"
        assert "seed" not in json.loads(after["run.json"])
    assert files_in(old) == after
    assert list(old.parent.iterdir()) == [old]


def test_run_folder_that_is_the_current_one_stays_the_same_folder(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(old)
    run_into(Path(), overwrite=True)
    assert changed_files(Path()) == []
    assert set(files_in(Path.cwd())) == {*FILES, "notes/a.txt"}


def test_run_folder_behind_a_link_replaces_what_the_link_names(old: Path) -> None:
    link = old.parent / "latest"
    link.symlink_to(old)
    run_into(link, overwrite=True)
    assert link.is_symlink()
    assert "seed" not in json.loads((old / "run.json").read_text())


def test_run_folder_keeps_files_of_other_programs_that_come_meanwhile(tmp_path: Path, system: str) -> None:
    directory = tmp_path / "runs" / "scan"
    with run_folder(directory) as folder:
        directory.mkdir()
        (directory / "notes.txt").write_text("a note")
        write_all(folder)
    assert set(files_in(directory)) == {*FILES, "notes.txt"}
