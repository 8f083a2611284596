from __future__ import annotations

import json
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import FrameSpan, OutputError, Panorama
from photonpano.geometry import Canvas, translation
from photonpano.merging.panorama import RenderedPanorama, Tile
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.testing import KnownMotion

FLUX = np.random.default_rng(0).random((60, 90), np.float32)
FLUX[:, :5] = np.nan
PANORAMA = Panorama(FLUX, np.where(np.isnan(FLUX), np.float32(0), np.float32(7)), translation(3, 4))
CANVAS = Canvas(60, 90, PANORAMA.canvas)
PICTURE = np.arange(60 * 90, dtype=np.uint8).reshape(60, 90)
FILES = {"panorama.tiff", "panorama.png", "coverage.tiff", "trajectory.npz", "run.json", "report.html"}


MOTION = FrameMotion(
    KnownMotion(lambda _: np.eye(3)),
    FrameSpan(0, 500),
    np.random.default_rng(0).random((500, 3, 3)),
    np.ones(500, bool),
    np.ones(500),
    250,
    (48, 64),
)
RENDERED = RenderedPanorama(CANVAS, PANORAMA, 1, PICTURE, 1.0, 0.9, 2.0)


def write_panorama(folder: RunFolder) -> None:
    folder.write_tile(Tile(0, 0, CANVAS), PANORAMA, CANVAS)


def write_results(folder: RunFolder) -> None:
    folder.write_results(RENDERED, MOTION, {"warnings": ["a line"] * 2000})


def write_report(folder: RunFolder) -> None:
    folder.write_report("<html>µ</html>" * 2000)


WRITERS = (write_panorama, write_results, write_report)


def write_all(folder: RunFolder) -> None:
    for write in WRITERS:
        write(folder)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A run folder of an earlier run, and a note of its owner."""
    for name in [*FILES, "notes.txt"]:
        (tmp_path / "runs").mkdir(exist_ok=True)
        (tmp_path / "runs" / name).write_text(f"old {name}")
    return tmp_path / "runs"


def require_old(directory: Path) -> None:
    assert {file.name for file in directory.iterdir()} == {*FILES, "notes.txt"}
    assert all(file.read_text() == f"old {file.name}" for file in directory.iterdir())


def test_run_folder_holds_the_written_files(tmp_path: Path) -> None:
    with run_folder(tmp_path / "runs" / "scan") as folder:
        write_all(folder)
    directory = tmp_path / "runs" / "scan"
    assert {file.name for file in directory.iterdir()} == FILES
    np.testing.assert_array_equal(tifffile.imread(directory / "panorama.tiff"), FLUX)
    np.testing.assert_array_equal(tifffile.imread(directory / "coverage.tiff"), PANORAMA.weight)
    np.testing.assert_array_equal(cv2.imread(str(directory / "panorama.png"), cv2.IMREAD_UNCHANGED), PICTURE)
    with np.load(directory / "trajectory.npz") as archive:
        assert set(archive.files) == {"homographies", "canvas", "frame_shape", "reference", "located", "std_px"}
        assert tuple(archive["frame_shape"]) == (48, 64)
    assert json.loads((directory / "run.json").read_text()) == {"warnings": ["a line"] * 2000}
    assert (directory / "report.html").read_text(encoding="utf-8").startswith("<html>µ</html>")


def test_run_folder_renames_no_file_before_the_block_ends(old: Path) -> None:
    with run_folder(old) as folder:
        write_all(folder)
        assert all(file.read_text() == f"old {file.name}" for file in old.iterdir() if file.is_file())
    assert (old / "notes.txt").read_text() == "old notes.txt"
    assert json.loads((old / "run.json").read_text())["warnings"]
    assert {file.name for file in old.iterdir()} == {*FILES, "notes.txt"}


def write_and_fail(directory: Path, error: BaseException) -> None:
    with run_folder(directory) as folder:
        write_all(folder)
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_run_folder_keeps_old_files_when_the_block_raises(old: Path, error: type[BaseException]) -> None:
    with pytest.raises(error):
        write_and_fail(old, error())
    require_old(old)


def test_run_folder_removes_new_folders_when_the_block_raises(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="half-way"):
        write_and_fail(tmp_path / "runs" / "today" / "scan", ValueError("half-way"))
    assert list(tmp_path.iterdir()) == []


def test_run_folder_keeps_files_of_other_programs(tmp_path: Path) -> None:
    def meet_another() -> None:
        with run_folder(tmp_path / "runs" / "scan"):
            (tmp_path / "runs" / "notes.txt").write_text("a note")
            raise ValueError("half-way")

    with pytest.raises(ValueError, match="half-way"):
        meet_another()
    assert list(tmp_path.rglob("*")) == [tmp_path / "runs", tmp_path / "runs" / "notes.txt"]


@contextmanager
def files_of_at_most(n_bytes: int) -> Iterator[None]:
    """Let the system cut short what is written, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("write", WRITERS)
def test_run_folder_keeps_old_files_when_the_disk_is_full(old: Path, write: Callable[[RunFolder], None]) -> None:
    with pytest.raises(OutputError) as caught, run_folder(old) as folder, files_of_at_most(4096):
        write(folder)
    assert str(caught.value) == (
        f"{old}: the results could not be written (File too large); what was there before is unchanged. "
        "Make room, or choose another folder with --output"
    )
    require_old(old)


def test_run_folder_refuses_a_file_in_the_way_before_the_block(tmp_path: Path) -> None:
    """As root, permissions stop nobody; a file does."""
    way = tmp_path / "runs"
    way.write_text("a file")
    for directory, reason in ((way, "File exists"), (way / "scan", "Not a directory")):
        with pytest.raises(OutputError) as caught, run_folder(directory):
            raise AssertionError("the block must not run")
        assert str(caught.value) == (
            f"{directory}: the run folder cannot be written to ({reason}); choose another one with --output"
        )
    assert way.read_text() == "a file"
