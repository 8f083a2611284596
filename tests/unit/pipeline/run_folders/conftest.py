"""A run folder of an earlier run, on systems of two kinds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .small_results import RECORD, run_into


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A run folder of an earlier run, and a note of its owner."""
    run_into(tmp_path / "runs")
    (tmp_path / "runs" / "run.json").write_text(json.dumps(RECORD | {"seed": "old"}))
    (tmp_path / "runs" / "notes").mkdir()
    (tmp_path / "runs" / "notes" / "a.txt").write_text("a note")
    return tmp_path / "runs"


@pytest.fixture(params=["exchange", "pending"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A system that exchanges folders in one step, and one that cannot."""
    if request.param == "pending":
        monkeypatch.setattr("photonpano.folders._exchange", lambda *_: False)
    return str(request.param)
