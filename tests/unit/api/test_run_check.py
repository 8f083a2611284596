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
