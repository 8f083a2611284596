from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.api.info import percent


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    """A simulated capture in the current folder: 200 frames, a pan of 0.1 px a frame."""
    shutil.copy(finished / "cube.npy", folder / "cube.npy")
    return folder / "cube.npy"


def test_info_group_size_is_that_of_run(cube: Path, invoke: Callable[..., Any]) -> None:
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    (cube.parent / "scan.yaml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy}}\nlevels: 1\n")
    assert invoke("run", "scan.yaml").exit_code == 0
    decisions = json.loads((cube.parent / "runs" / "scan" / "run.json").read_text())["decisions"]
    assert {each["what"]: (each["value"], each["reason"]) for each in decisions} == {
        "source": ("packed-npy", facts["reason"]),
        "still_pixels": (0, facts["still_how"]),
        "standing_share": (
            facts["standing_share"],
            "share of the frame that stands still, of the parts that show motion or rest",
        ),
        "group_size": (facts["group_size"], facts["group_size_reason"]),
    }


def test_info_warns_of_hot_and_saturated_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((600, 64, 64)) < 0.1
    frames[:, rng.random((64, 64)) < 0.02] = True
    frames[:, :8] = True
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert facts["hot_share"] == pytest.approx(0.02 * 7 / 8, abs=0.006)
    assert facts["saturated_share"] == pytest.approx(frames.all(axis=0).mean())
    hot, *_, saturated = invoke("info", "cube.npy").stderr.splitlines()
    assert (
        hot == f"warning: about {percent(facts['hot_share'])} of the pixels are hot; mask them with the correction hot-pixels"
    )
    assert saturated.startswith("warning: 14 % of the pixels have their highest value in every frame, so that ")
