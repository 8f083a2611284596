"""Check a finished run by its capture: the verdict is that of the run, and wrong input is named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import InputError, check_run
from photonpano.pipeline.run import RunResult
from photonpano.residuals.verdict import REPEATS


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


def change_trajectory(folder: Path, **arrays: np.ndarray | None) -> None:
    """Replace arrays of the trajectory, or leave them out."""
    with np.load(folder / "trajectory.npz") as archive:
        kept = {**archive, **arrays}
    np.savez(folder / "trajectory.npz", **{name: array for name, array in kept.items() if array is not None})


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
    assert found.unknown == ()
    assert {file: (file.stat().st_mtime_ns, file.stat().st_size) for file in finished.parent.rglob("*")} == before


def test_check_run_doubts_other_photons_of_the_same_size(finished: Path) -> None:
    cube = finished.parent / "cube.npy"
    np.save(cube, np.load(cube)[:, ::-1])
    assert error_of(finished) == f"{finished}: the capture has other frames than when it was run; it is another capture"
    change(finished, lambda record: record.pop("capture"))  # as in older versions
    verdict = check_run(finished).verdict
    assert verdict.status == "doubtful"
    assert any(reason.what.startswith("the panorama does not explain the photons") for reason in verdict.reasons)


def test_check_run_refuses_missing_capture(finished: Path) -> None:
    cube = finished.parent / "cube.npy"
    cube.unlink()
    assert error_of(finished) == (
        f"{finished}: the capture of this run cannot be opened by its recorded spec "
        f"(source: there is no file {cube}; check the path)"
    )


@pytest.mark.parametrize(("part", "size"), [(np.s_[:299], "299 frames of 128x160"), (np.s_[:, :120], "300 frames of 120x160")])
def test_check_run_refuses_capture_of_another_size(finished: Path, part: Any, size: str) -> None:
    cube = finished.parent / "cube.npy"
    np.save(cube, np.load(cube)[part])
    assert error_of(finished) == (
        f"{finished} is a run of 300 frames of 128x160, but its capture now has {size}; it is another capture"
    )


def test_check_run_of_older_version_says_what_it_cannot_judge(finished: Path, small_run: RunResult) -> None:
    def age(record: dict[str, Any]) -> None:
        del record["verdict"], record["refinements"], record["files"], record["capture"]
        for level in record["levels"]:
            del level["contradictions"]

    change(finished, age)
    change_trajectory(finished, std_px=None)
    found = check_run(finished)
    assert found.verdict.status == small_run.verdict.status
    assert found.unknown == (
        "trajectory.npz has no std_px, as it is of an older version: the expected error is not judged",
        "run.json does not list contradicting pairs, as it is of an older version: they are not judged",
    )


def test_check_run_judges_recorded_contradictions(finished: Path) -> None:
    pair = {"moving": [0, 50], "fixed": [50, 100]}
    change(finished, lambda record: record["levels"][-1].update(pairs=10, contradictions=[pair, pair]))
    assert check_run(finished).verdict.reasons[-1].where == "2 of 10 pairs of the last level"


def test_check_run_keeps_what_only_the_run_can_find(finished: Path) -> None:
    repeats = {"what": REPEATS, "figure": 0.2, "threshold": 0.05, "where": "4 of 20 pairs", "what_to_do": "look"}
    other = repeats | {"what": "the light changes over time"}
    standing = {"what": "standing_share", "value": 0.7, "reason": "measured"}
    change(finished, lambda record: record["verdict"].update(reasons=[repeats, other]))
    change(finished, lambda record: record["decisions"].insert(0, standing))
    found = [reason.what for reason in check_run(finished).verdict.reasons]
    assert found[-2:] == ["more than half of the frame stands still while the rest moves", REPEATS]
    assert other["what"] not in found


def test_check_run_refuses_folder_that_is_no_run(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    assert error_of(folder) == f"{folder} is not a folder; give the run folder that `photonpano run` wrote"
    folder.mkdir()
    assert error_of(folder) == (
        f"{folder} has no trajectory.npz, so no run has finished in it; give the folder of a finished run"
    )
    (finished / "run.json").unlink()
    assert error_of(finished) == f"{finished} has no run.json, so no run has finished in it; give the folder of a finished run"


def test_check_run_refuses_run_without_located_frames(finished: Path) -> None:
    change(finished, lambda record: record.pop("files"))
    change_trajectory(finished, located=np.zeros(300, np.bool_))
    assert error_of(finished) == f"{finished}: the run located no frame, so that it has no panorama"


def test_check_run_refuses_files_of_two_runs(finished: Path) -> None:
    change_trajectory(finished, std_px=np.zeros(300))
    assert error_of(finished) == (
        f"{finished}: trajectory.npz is not the file that its run.json lists; the folder mixes several runs, or a file was "
        "changed: run the spec again"
    )
