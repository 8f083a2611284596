"""Runs of small captures of every kind of motion: 900 frames of 96x128 px of a texture, with known truth."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import parse_spec
from photonpano.evaluation import corner_errors, load_run_trajectory
from photonpano.testing.scenes import detected, seen_along, textured

SHAPE, SCENE_SHAPE, N_FRAMES, FLUX = (96, 128), (400, 520), 900, 0.3
MOST_PX = {
    "shift-roll": 0.1,
    "roll-60": 0.1,
    "zoom": 0.2,
    "breathing": 0.2,
    "shear": 0.2,
    "keystone": 0.2,
    "f600": 0.1,
    "tripod": 0.1,
}
"""The mean error that a motion may have, by its name in `MOTIONS` of the benchmark."""
WITHIN_3 = 0.9

_SPEC = importlib.util.spec_from_file_location("motion_paths", Path(__file__).parents[1] / "benchmarks" / "motion_paths.py")
motion_paths = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(motion_paths)


@pytest.mark.parametrize("motion", MOST_PX)
def test_motion_is_found_by_default(motion: str, tmp_path: Path, outcome_of: Callable[..., Any]) -> None:
    seed = list(MOST_PX).index(motion)
    true = motion_paths.path_of(motion_paths.MOTIONS[motion], SHAPE, N_FRAMES, SCENE_SHAPE, seed)
    scene = textured(SCENE_SHAPE, FLUX, seed=seed).astype(np.float32)
    np.save(tmp_path / "cube.npy", np.packbits(detected(seen_along(scene, true, SHAPE), seed), axis=-1))
    outcome = outcome_of(
        parse_spec({"version": 1, "source": {"use": "packed-npy", "with": {"path": str(tmp_path / "cube.npy")}}})
    )

    found = load_run_trajectory(outcome.directory)
    score = corner_errors(found.corner_homographies, true, SHAPE, found.located)
    assert found.located.all()
    assert score.mean_px < MOST_PX[motion]
    if outcome.record["verdict"]["status"] == "trusted":
        assert np.mean(score.errors_px <= 3 * found.std_px) >= WITHIN_3
