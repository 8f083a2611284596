"""Captures named on the command line: options, and errors that name them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from photonpano.api.command import WrongArgumentError
from photonpano.cli.plans import capture_plan
from photonpano.errors import SpecError


@pytest.fixture
def cube(folder: Path) -> Path:
    np.save(folder / "cube.npy", np.zeros((20, 8, 2), np.uint8))
    return folder / "cube.npy"


def test_capture_plan_resolves_path_from_current_folder(cube: Path) -> None:
    with capture_plan(Path("cube.npy")) as plan:
        pass
    assert (plan.source.contribution.name, plan.source.config.path) == ("packed-npy", cube)


def test_capture_plan_reads_option_values_as_yaml(cube: Path) -> None:
    corrections = ["rot90", "{crop: {rows: [2, null]}}"]
    with capture_plan(Path("cube.npy"), "packed-npy", ["frame_rate_hz=1e3", "width=13"], corrections) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width) == (1000, 13)
    assert plan.document["corrections"] == ["rot90", {"crop": {"rows": [2, None], "columns": [None, None]}}]


def test_capture_plan_applies_options_to_spec(cube: Path) -> None:
    Path("scan.yml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy, frame_rate_hz: 7}}\nlevels: 2\n")
    with capture_plan(Path("scan.yml"), None, ["width=13"], ["rot90"]) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width, len(plan.levels)) == (7, 13, 2)
    assert plan.document["corrections"] == ["rot90"]
    with pytest.raises(SpecError), capture_plan(Path("scan.yml"), "nobody"):
        pass


def test_missing_library_of_recognised_source_names_no_option(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *args: None if name == "av" else found(name, *args))
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    with pytest.raises(WrongArgumentError) as caught, capture_plan(Path("film.mp4")):
        pass
    assert str(caught.value).startswith("the source 'video' needs av, which is not installed: pip install ")
