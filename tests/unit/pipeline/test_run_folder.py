"""Run folders: written whole or not at all, and never in place of what is not theirs."""

import errno
import hashlib
import json
import os
import re
import resource
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import FrameSpan, OutputError, Panorama
from photonpano.geometry import Canvas, translation
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano.merging.panorama import RenderedPanorama, Tile
from photonpano.motion.frame_motion import FrameMotion
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.record.contents import changed_files
from photonpano.testing import KnownMotion

FLUX = np.random.default_rng(0).random((60, 90), np.float32)
FLUX[:, :5] = np.nan
PANORAMA = Panorama(FLUX, np.where(np.isnan(FLUX), np.float32(0), np.float32(7)), translation(3, 4))
STD = np.full_like(FLUX, 0.1)
CANVAS = Canvas(60, 90, PANORAMA.canvas)
PICTURE = np.arange(60 * 90, dtype=np.uint8).reshape(60, 90)
FILES = {
    "panorama.tiff",
    "panorama-std.tiff",
    "panorama.png",
    "coverage.tiff",
    "first-frame.tiff",
    "last-frame.tiff",
    "trajectory.npz",
    "run.json",
    "report.html",
}
MOTION = FrameMotion(
    trajectory=KnownMotion(lambda _: np.eye(3)),
    span=FrameSpan(0, 500),
    homographies=np.random.default_rng(0).random((500, 3, 3)),
    located=np.ones(500, bool),
    std_px=np.ones(500),
    reference=250,
    frame_shape=(48, 64),
)
SEEN = np.zeros((2, *PANORAMA.flux.shape[:2]), np.uint32)
MAPS = PANORAMA.flux, PANORAMA.weight, STD, *SEEN
RANGE = DynamicRange(noise=CanvasNoise(response=BinaryResponse()))
RENDERED = RenderedPanorama(
    canvas=CANVAS,
    thumbnail=PANORAMA,
    reduction=1,
    picture=PICTURE,
    white_flux=1.0,
    coverage_share=0.9,
    seconds=2.0,
    std=STD,
    seen_frames=SEEN,
    dynamic_range=RANGE,
)
RECORD: Any = {"photonpano": "0", "spec": {}, "warnings": ["a line"] * 2000}

WRITERS: Mapping[str, Callable[[RunFolder], object]] = {
    "panorama": lambda folder: folder.write_tile(Tile(0, 0, CANVAS), MAPS, CANVAS, "cube.npy"),
    "results": lambda folder: folder.write_results(RENDERED, MOTION),
    "record": lambda folder: folder.commit(RECORD),
}


def write_images(folder: RunFolder) -> None:
    WRITERS["panorama"](folder)
    WRITERS["results"](folder)


def write_all(folder: RunFolder) -> None:
    """Write a run as `run` does: the results, and then the report."""
    write_images(folder)
    record = folder.commit(RECORD)
    folder.add_report("<html>µ</html>" * 2000)
    folder.update(record)


def run_into(directory: Path, **options: Any) -> None:
    with run_folder(directory, **options) as folder:
        write_all(folder)


def files_in(directory: Path) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def old_run(folder: Path) -> Path:
    """Write a run folder of an earlier run, and a note of its owner."""
    run_into(folder / "runs")
    record = folder / "runs" / "run.json"
    record.write_text(json.dumps(json.loads(record.read_text()) | {"seed": "old"}))
    (folder / "runs" / "notes").mkdir()
    (folder / "runs" / "notes" / "a.txt").write_text("a note")
    return folder / "runs"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    return old_run(tmp_path)


def test_run_folder_holds_the_written_files(tmp_path: Path) -> None:
    run_into(tmp_path / "runs" / "scan")
    directory = tmp_path / "runs" / "scan"
    assert set(files_in(directory)) == FILES
    np.testing.assert_array_equal(tifffile.imread(directory / "panorama.tiff"), FLUX)
    np.testing.assert_array_equal(tifffile.imread(directory / "coverage.tiff"), PANORAMA.weight)
    shown = np.where(np.isnan(FLUX), 0, np.maximum(PICTURE, 1))
    np.testing.assert_array_equal(cv2.imread(str(directory / "panorama.png"), cv2.IMREAD_UNCHANGED), shown)
    with np.load(directory / "trajectory.npz") as archive:
        names = "homographies canvas projection horizon frame_shape reference located std_px"
        assert set(archive.files) == set(names.split())
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


def test_run_folder_is_replaced_and_keeps_other_files(old: Path) -> None:
    before = files_in(old)
    with run_folder(old, overwrite=True) as folder:
        write_images(folder)
        assert files_in(old) == before
        folder.commit(RECORD)
        after = files_in(old)
        assert set(after) == (FILES - {"report.html"}) | {"notes/a.txt"}
        assert after["notes/a.txt"] == b"a note"
        assert "seed" not in json.loads(after["run.json"])
    assert files_in(old) == after
    assert list(old.parent.iterdir()) == [old]


def refusal(directory: Path, **options: Any) -> str:
    """Return why a folder is refused, before anything is written."""
    with pytest.raises(OutputError) as caught, run_folder(directory, **options):
        raise AssertionError("the block must not run")
    return str(caught.value)


def test_run_folder_refuses_files_that_no_run_wrote(old: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    for name in ("report.html", "run.json", "a.png", "b.png", "c.png"):
        (mine / name).write_text("mine")
    for directory, names in ((old, "notes"), (mine, "a.png, b.png, c.png and 2 more")):
        before = files_in(directory)
        assert refusal(directory) == (
            f"{directory} holds files that no run has written: {names}; choose another folder with --output, "
            "or write the results among them with --overwrite"
        )
        assert files_in(directory) == before


def test_run_folder_refuses_what_must_not_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home" / "me"))
    (tmp_path / "home" / "me").mkdir(parents=True)
    capture = tmp_path / "captures" / "night" / "cube.npy"
    for directory in (Path("/"), tmp_path / "home", tmp_path / "home" / "me", tmp_path / "captures", capture):
        reason = "is the folder of a user or of the system; choose another one"
        if directory in (tmp_path / "captures", capture):
            reason = f"cannot be written, since {capture}, which is read, lies in it; choose another folder"
        found = refusal(directory, overwrite=True, inputs=[capture])
        assert found == f"{directory} {reason}"


def test_second_run_into_a_folder_is_refused_with_the_first(tmp_path: Path) -> None:
    directory = tmp_path / "scan"
    with run_folder(directory):
        refused = refusal(directory)
    assert re.fullmatch(
        rf"the run folder {directory} is in use: process {os.getpid()} on {socket.gethostname()} has been writing it since "
        r"20\d\d-\S+; wait for it, or choose another folder with --output",
        refused,
    )
    assert list(tmp_path.iterdir()) == []


def test_run_folder_refuses_a_run_of_another_capture(tmp_path: Path) -> None:
    captures = [tmp_path / "a.npy", tmp_path / "b.npy"]
    for path in captures:
        path.touch()
    with run_folder(tmp_path / "scan", inputs=captures[:1]) as folder:
        folder.commit(RECORD | {"capture": {"files": [{"path": str(captures[0])}]}})
    assert refusal(tmp_path / "scan", inputs=captures[1:]) == (
        f"{tmp_path}/scan holds a run of another capture, {captures[0]}; choose another folder with --output, or replace that "
        "run with --overwrite"
    )
    captures[0].rename(tmp_path / "moved.npy")  # as when all of a project moves
    run_into(tmp_path / "scan", inputs=captures[1:])


def write_and_fail(directory: Path, error: BaseException) -> None:
    with run_folder(directory, overwrite=True) as folder:
        write_images(folder)
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_run_folder_keeps_old_files_and_makes_no_new_folders_when_the_block_raises(
    old: Path, error: type[BaseException]
) -> None:
    before = files_in(old.parent)
    for directory in (old, old.parent / "today" / "scan"):
        with pytest.raises(error):
            write_and_fail(directory, error())
    assert files_in(old.parent) == before
    assert list(old.parent.iterdir()) == [old]


@contextmanager
def files_of_at_most(n_bytes: int) -> Iterator[None]:
    """Let the system cut short what is written, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("result", WRITERS)
def test_run_folder_keeps_old_files_when_the_disk_is_full(old: Path, result: str) -> None:
    before = files_in(old.parent)
    with pytest.raises(OutputError) as caught, run_folder(old, overwrite=True) as folder, files_of_at_most(4096):
        WRITERS[result](folder)
    assert str(caught.value) == (
        f"{old}: the results could not be written (File too large); what was there before is unchanged. "
        "Make room, or choose another folder with --output"
    )
    assert files_in(old.parent) == before


def test_temporary_files_lie_beside_the_run_folder_where_the_system_has_no_place(
    old: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere() -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "gettempdir", nowhere)
    monkeypatch.setattr(tempfile, "tempdir", None)
    with run_folder(old, overwrite=True):
        assert tempfile.tempdir == str(old.parent)


@pytest.mark.parametrize("number", range(16))
def test_run_folder_is_old_or_new_when_any_step_fails_once(old: Path, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    before, steps = files_in(old), []

    def failing(name: str) -> Callable[..., Any]:
        step = getattr(os, name)

        def maybe(*args: Any, **options: Any) -> Any:
            steps.append(name)
            if len(steps) - 1 == number:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return step(*args, **options)

        return maybe

    with suppress(OutputError), run_folder(old, overwrite=True) as folder:
        write_images(folder)
        with monkeypatch.context() as patch:
            for name in ("rename", "replace", "fsync", "link"):
                patch.setattr(os, name, failing(name))
            folder.commit(RECORD)
    after = files_in(old)
    if after != before:
        assert changed_files(old) == []
        assert "seed" not in json.loads(after["run.json"])
        assert set(after) == (FILES - {"report.html"}) | {"notes/a.txt"}
    assert list(old.parent.iterdir()) == [old]


_STOPS = """
import os, signal, sys
from pathlib import Path
from photonpano.pipeline.run_folder import run_folder

left = int(sys.argv[2])

def counted(rename):
    def maybe(*args):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(*args)
    return maybe

os.rename, os.replace = counted(os.rename), counted(os.replace)
with run_folder(Path(sys.argv[1]), overwrite=True) as folder:
    (folder.staging / "panorama.tiff").write_bytes(b"new")
    record = folder.commit({"photonpano": "0", "spec": {}})
    folder.add_report("new")
    folder.update(record)
"""


@pytest.mark.parametrize("n_renames", range(4))
def test_next_run_recovers_from_a_killed_run(old: Path, n_renames: int) -> None:
    """A run is killed before it puts the old folder aside, while there is none, and while it adds the report."""
    before = files_in(old)
    subprocess.run([sys.executable, "-c", _STOPS, old, str(n_renames)], check=False)
    assert len(list(old.parent.iterdir())) > 1
    assert old.exists() == (n_renames != 1)
    with run_folder(old, overwrite=True):
        if n_renames < 2:
            assert files_in(old) == before
        else:
            report = {"report.html"} if n_renames == 3 else set()
            assert changed_files(old) == []
            assert set(files_in(old)) == {"panorama.tiff", "run.json", "notes/a.txt", *report}
    assert list(old.parent.iterdir()) == [old]
