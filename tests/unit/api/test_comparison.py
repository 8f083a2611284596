"""`compare`: runs of one capture side by side."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano import InputError, OutputError, compare, parse_spec, run
from photonpano.evaluation import RunTrajectory
from photonpano.evaluation.comparison import motion_difference, on_canvas
from photonpano.geometry import Canvas, translation
from photonpano.pipeline.run import RunResult


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


def changed(folder: Path, copy: Path, **record: Any) -> Path:
    """Copy a run, and change its record."""
    shutil.copytree(folder, copy)
    content = json.loads((copy / "run.json").read_text(encoding="utf-8"))
    (copy / "run.json").write_text(json.dumps(content | record), encoding="utf-8")
    return copy


def test_runs_of_different_captures_are_refused_by_name(small_run: RunResult, tmp_path: Path) -> None:
    capture = small_run.record["capture"]
    files = [{**capture["files"][0], "path": "/data/bridge.npy"}]
    other = changed(small_run.directory, tmp_path / "other", capture={**capture, "files": files, "frames_sha256": "0"})
    with pytest.raises(InputError) as caught:
        compare([small_run.directory, other], tmp_path / "page.html")
    assert f"{other} is a run of bridge.npy (300 frames): these are different captures" in str(caught.value)
    assert not (tmp_path / "page.html").exists()


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


def test_page_that_cannot_be_written_is_an_error(small_run: RunResult, once: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        compare([small_run.directory, once], tmp_path / "nowhere" / "page.html")


def test_file_of_another_kind_is_not_replaced(small_run: RunResult, once: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes.txt"
    notes.write_text("precious", encoding="utf-8")
    with pytest.raises(OutputError, match=r"notes\.txt: the page is HTML; choose a name that ends in \.html"):
        compare([small_run.directory, once], notes)
    assert notes.read_text(encoding="utf-8") == "precious"


def test_same_motions_are_said_to_be_the_same(small_run: RunResult, tmp_path: Path) -> None:
    record = small_run.record
    spec = {**record["spec"], "output": {**record["spec"]["output"], "keep": "exposures"}}
    copy = changed(small_run.directory, tmp_path / "copy", spec=spec)
    found = compare([small_run.directory, copy], tmp_path / "page.html")
    page = found.page.read_text(encoding="utf-8")
    assert found.mean_difference_px == (None, 0.0)
    assert "All runs have the same motion." in page
    assert re.findall(r'<td data-name="(?:small|copy)">(null|exposures)</td>', page) == ["null", "exposures"]


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
