"""Finished runs are compared, checked, verified, and cleaned up after."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano import InputError, check_run, clean, compare, parse_spec, run, verify
from photonpano.evaluation import RunTrajectory
from photonpano.evaluation.run_scores import motion_difference, on_canvas
from photonpano.files.folders import locked
from photonpano.geometry import Canvas, translation
from photonpano.pipeline.run import RunResult


@pytest.fixture
def finished(small_run: RunResult, small_capture: Path, tmp_path: Path) -> Path:
    """A copy of a run folder, `run`, of a capture beside it, `cube.npy`."""
    shutil.copytree(small_run.directory, tmp_path / "run")
    shutil.copy(small_capture, tmp_path / "cube.npy")
    change(tmp_path / "run", lambda record: record["spec"]["source"]["with"].update(path=str(tmp_path / "cube.npy")))
    return tmp_path / "run"


def change(folder: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    """Change the record of a run."""
    record = json.loads((folder / "run.json").read_text())
    edit(record)
    (folder / "run.json").write_text(json.dumps(record))


def error_of(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        check_run(folder)
    return str(caught.value)


def test_check_run_judges_as_the_run_did_and_writes_nothing(finished: Path, small_run: RunResult) -> None:
    before = {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in finished.parent.rglob("*")}
    found = check_run(finished)
    assert found.verdict.status == small_run.verdict.status
    assert [reason.what for reason in found.verdict.reasons] == [reason.what for reason in small_run.verdict.reasons]
    assert found.verdict.residual_ratio == pytest.approx(small_run.verdict.residual_ratio, rel=0.02)
    assert {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in finished.parent.rglob("*")} == before


def test_findings_that_no_run_writes_are_named_and_older_runs_have_none(finished: Path) -> None:
    change(finished, lambda record: record["findings"].update(standing_share="most"))
    assert error_of(finished) == (
        f"{finished / 'run.json'}: cannot be read as the record of a run (findings.standing_share: Input should be a valid "
        "number, unable to parse string as a number); give the folder of a finished run"
    )
    change(finished, lambda record: record.pop("findings"))
    assert check_run(finished).verdict.status == "trusted"


def test_check_run_doubts_other_photons_of_the_same_size(finished: Path) -> None:
    cube = finished.parent / "cube.npy"
    np.save(cube, np.load(cube)[:, ::-1])
    assert error_of(finished) == f"{finished}: the capture has other frames than when it was run; it is another capture"
    change(finished, lambda record: record.pop("capture"))
    verdict = check_run(finished).verdict
    assert verdict.status == "doubtful"
    assert any(reason.what.startswith("the panorama does not explain the photons") for reason in verdict.reasons)


def test_check_run_opens_a_capture_that_was_moved(finished: Path) -> None:
    verdict, cube = check_run(finished).verdict, finished.parent / "cube.npy"
    moved = cube.rename(cube.with_name("moved.npy"))
    assert error_of(finished).endswith(
        "if it was moved, name it with --capture PATH, or, where a command has --set, with --set source.with.path=PATH"
    )
    assert check_run(finished, capture=moved).verdict == verdict
    np.save(moved, np.load(moved)[:, ::-1])
    with pytest.raises(InputError, match="it is another capture"):
        check_run(finished, capture=moved)


@pytest.fixture
def copied(small_run: RunResult, tmp_path: Path) -> Path:
    shutil.copytree(small_run.directory, tmp_path / "run")
    return tmp_path / "run"


def test_verify_accepts_a_finished_run(small_run: RunResult) -> None:
    found = verify(small_run.directory)
    assert (found.n_files, found.problems, found.capture) == (8, (), "the same frames")
    assert found.n_bytes == sum(path.stat().st_size for path in small_run.directory.iterdir() if path.name != "run.json")


def test_verify_finds_what_differs(copied: Path) -> None:
    (copied / "report.html").unlink()
    with (copied / "panorama.tiff").open("r+b") as file:
        file.seek(-1, os.SEEK_END)
        file.write(b"\x07")
    target = (copied / "trajectory.npz").rename(copied.parent / "elsewhere.npz")
    (copied / "trajectory.npz").symlink_to(target)
    record = json.loads((copied / "run.json").read_text())
    record["capture"]["frames_sha256"] = "0"
    (copied / "run.json").write_text(json.dumps(record))
    assert verify(copied).problems == (
        "report.html is missing",
        "panorama.tiff is not the file that the run wrote",
        "trajectory.npz is not the file that the run wrote",
        "the frames are others",
    )


def test_clean_removes_leftovers_only(tmp_path: Path) -> None:
    import gzip

    with gzip.open(tmp_path / "cube.npy.gz", "wb") as file:
        np.save(file, np.zeros((4, 5, 6), np.uint8))
    (tmp_path / "cube.npy.gz.unpacked.npy").write_bytes(b"old")
    (tmp_path / "lost.npy.gz.unpacked.npy").write_bytes(b"its archive is gone")
    left = [".scan.photonpano-new/panorama.tiff", ".cube.0123abcd.partial.npy", ".scan.lock", "runs/.old.photonpano-old/a"]
    kept = [".new.0123abcd.partial.npy", "cube.npy.part", ".mine.lock", ".partial", ".used.photonpano-new/a", "runs/old/a"]
    for name in (*left, *kept):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("process 1 on a" if name == ".scan.lock" else "content")
    os.utime(tmp_path / ".cube.0123abcd.partial.npy", (0, 0))
    (tmp_path / ".link.0123abcd.partial").symlink_to(tmp_path / ".partial")
    before = {path for path in tmp_path.rglob("*") if path.is_file() or path.is_symlink()}
    places = [str(Path(name).parent if name.endswith(("tiff", "/a")) else name) for name in left]
    expected = sorted(tmp_path / name for name in (*places, "cube.npy.gz.unpacked.npy"))
    with locked(tmp_path / "used", "used"):
        assert sorted(clean(tmp_path, dry_run=True)) == expected
        assert sorted(clean(tmp_path)) == expected
    removed = before - {path for path in tmp_path.rglob("*") if path.is_file() or path.is_symlink()}
    assert removed == {tmp_path / name for name in (*left, "cube.npy.gz.unpacked.npy")}
    with pytest.raises(InputError) as caught:
        clean(tmp_path / "nowhere")
    assert str(caught.value) == f"there is no folder {tmp_path}/nowhere; check the path"


def test_clean_puts_back_a_folder_that_was_put_aside(tmp_path: Path) -> None:
    (tmp_path / ".scan.photonpano-old").mkdir()
    (tmp_path / ".scan.photonpano-old" / "run.json").write_text("{}")
    assert clean(tmp_path) == [tmp_path / ".scan.photonpano-old"]
    assert [path.name for path in tmp_path.rglob("*")] == ["scan", "run.json"]


@pytest.fixture(scope="module")
def once(small_spec: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the small capture with one level."""
    folder = tmp_path_factory.mktemp("runs") / "one <level>"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "<html></html>")
        return run(parse_spec(small_spec | {"levels": 1}, output=folder)).directory


def test_page_lays_runs_side_by_side(small_run: RunResult, once: Path, tmp_path: Path) -> None:
    found = compare([small_run.directory, once], tmp_path / "page.html")
    page = found.page.read_text(encoding="utf-8")
    body = ElementTree.fromstring(page).find("body")
    assert body is not None
    text = " ".join(" ".join(body.itertext()).split())
    assert found.runs == ("small", "one <level>")
    assert found.mean_difference_px[0] is None
    assert 0.001 < (found.mean_difference_px[1] or 0) < 1
    assert page.count("data:image/jpeg") == 2
    assert "levels 3 1" in text
    assert "corner error (px)" in text  # the truth lies beside the capture
    assert "2 runs of one capture: 300 binary frames" in text
    assert not re.findall(r"""src=["'](?!data:)""", page)
    links = [element.attrib["href"] for element in body.iter("a")]
    assert links[0].endswith("small/report.html")
    assert links[1].endswith("one%20%3Clevel%3E/report.html")


def test_wrong_folders_are_refused(small_run: RunResult, tmp_path: Path) -> None:
    folder = small_run.directory
    page = tmp_path / "page.html"
    with pytest.raises(InputError, match="at least two different run folders"):
        compare([folder, folder / ".." / folder.name], page)
    with pytest.raises(InputError, match="is not a folder"):
        compare([folder, tmp_path / "nowhere"], page)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no run has finished in it"):
        compare([folder, tmp_path / "empty"], page)
    shutil.copytree(folder, tmp_path / "damaged")
    (tmp_path / "damaged" / "panorama.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"is not the file that its run\.json lists"):
        compare([folder, tmp_path / "damaged"], page)
    assert not page.exists()


def motion_of(homographies: np.ndarray, located: np.ndarray) -> RunTrajectory:
    return RunTrajectory(homographies, np.eye(3), (40, 60), located, np.zeros(len(homographies)))


def test_motion_difference_ignores_the_plane_and_finds_the_frame() -> None:
    path = np.array([translation(2.0 * k, np.sin(k)) for k in range(30)])
    plane = translation(5, -7) @ np.array([[1.02, 0.01, 0], [0.0, 0.99, 0], [1e-5, 0, 1]])
    other = plane @ path
    other[7] = plane @ path[7] @ translation(0.5, 0)
    located = np.ones(30, dtype=bool)
    located[20] = False
    found = motion_difference(motion_of(path, np.ones(30, dtype=bool)), motion_of(other, located))
    assert found is not None
    assert found.corners_px[7] == pytest.approx(0.5, abs=0.1)
    assert np.isnan(found.corners_px[20])
    assert np.nanmax(np.delete(found.corners_px, 7)) < 0.1
    assert motion_difference(motion_of(path, located), motion_of(path, ~located)) is None


def test_panorama_is_moved_onto_the_common_canvas_with_one_white() -> None:
    picture = np.random.default_rng(0).integers(1, 255, (30, 50), np.uint8)
    canvas, common = Canvas(30, 50, translation(3, 4)), Canvas(20, 30, translation(-7, 0))
    moved = on_canvas(picture, canvas, np.eye(3), common, None)
    np.testing.assert_array_equal(moved, picture[4:24, 10:40])
    darker = on_canvas(picture, canvas, np.eye(3), common, (1.0, 2.0))
    assert (darker < moved)[moved > 20].all()


def test_pictures_larger_than_opencv_warps_are_compared_too() -> None:
    wide = np.tile(np.repeat(np.array([50, 200], np.uint8), 400), (20, 50))
    moved = on_canvas(wide, Canvas(*wide.shape, np.eye(3)), np.eye(3), Canvas(20, 2000, np.eye(3)), None)
    assert moved[10, [200, 600, 1000, 1400, 1800]].tolist() == [50, 200, 50, 200, 50]


@pytest.mark.parametrize("foreign", [{"a": np.zeros(3)}, {"homographies": np.eye(3)[None], "frame_shape": np.array([2, 2])}])
def test_foreign_truth_beside_the_capture_does_not_end_a_comparison(
    small_run: RunResult, small_capture: Path, foreign: dict[str, np.ndarray], tmp_path: Path
) -> None:
    capture = Path(shutil.copy(small_capture, tmp_path / "cube.npy"))
    np.savez(tmp_path / "cube.truth.npz", **foreign)
    runs = []
    for name in ("one", "two"):
        folder = Path(shutil.copytree(small_run.directory, tmp_path / name))
        record = json.loads((folder / "run.json").read_text())
        record["capture"]["files"][0]["path"] = str(capture)
        (folder / "run.json").write_text(json.dumps(record))
        runs.append(folder)
    assert compare(runs, tmp_path / "page.html").page.exists()
