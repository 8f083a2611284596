"""Runs of small captures of every kind of motion: 400 frames of 96x128 px of a texture, with known truth."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import parse_spec
from photonpano.evaluation import corner_errors, load_run_trajectory
from photonpano.geometry import corner_displacements
from photonpano.testing.captures import detected, seen_along, textured

SHAPE, SCENE_SHAPE, N_FRAMES, FLUX = (96, 128), (400, 520), 400, 0.3
FEW_ROWS = (8, 512)
MOST_PX = {
    "roll-60": 0.1,
    "zoom": 0.2,
    "keystone": 0.2,
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
    mean_px, within_3 = run_along(true, scene, SHAPE, tmp_path, outcome_of)
    assert mean_px < MOST_PX[motion]
    assert within_3 >= WITHIN_3


def test_frames_of_few_rows_are_located(tmp_path: Path, outcome_of: Callable[..., Any]) -> None:
    """Pairs of which a single row overlaps say nothing of some directions."""
    true = np.tile(np.eye(3), (600, 1, 1))
    true[:, 0, 2], true[:, 1, 2] = 20 + np.linspace(0, 200, 600), 200 + 3 * np.sin(np.arange(600) / 90)
    scene = textured((400, 900), FLUX, seed=1).astype(np.float32)
    mean_px, within_3 = run_along(true, scene, FEW_ROWS, tmp_path, outcome_of)
    assert mean_px < 0.3
    assert within_3 >= WITHIN_3


def test_motion_that_returns_within_groups_is_doubted(tmp_path: Path, outcome_of: Callable[..., Any]) -> None:
    """In groups of whole periods, a dither averages away, and in the dark no span shows where it lies."""
    frames = np.arange(3000)
    true = np.tile(np.eye(3), (len(frames), 1, 1))
    true[:, 0, 2], true[:, 1, 2] = 60 + 4 * np.sin(frames * 2 * np.pi / 200), 60 + 3 * np.cos(frames * 2 * np.pi / 200)
    spec, said = spec_of(true, textured((220, 260), 0.015, seed=3).astype(np.float32), SHAPE, tmp_path), {}
    for size in (400, 40):
        resample = {"use": "midpoint", "with": {"group_size": size}}
        outcome = outcome_of(parse_spec(spec | {"resample": resample, "levels": 1, "refine": []}))
        said[size] = [each["what"] for each in outcome.record["verdict"]["reasons"]]
    reason = "neighbouring frames have in common what the motion and the panorama do not show"
    assert (reason in said[400], reason in said[40]) == (True, False), said


def test_pan_past_a_wall_with_one_line_is_not_trusted(tmp_path: Path, outcome_of: Callable[..., Any]) -> None:
    """For a while, frames see nothing but a line along which they move: pairs of them err, and claim to know."""
    true = np.tile(np.eye(3), (500, 1, 1))
    true[:, 0, 2], true[:, 1, 2] = 10 + np.linspace(0, 280, 500), 15 + 6 * np.sin(np.linspace(0, 2 * np.pi, 500))
    scene = textured((140, 450), FLUX, seed=2).astype(np.float32)
    scene[:, 110:250], scene[62:64, 110:250] = FLUX, 0.6 * FLUX
    outcome = outcome_of(parse_spec(spec_of(true, scene, SHAPE, tmp_path) | {"levels": 2}))
    found = load_run_trajectory(outcome.directory)
    [reason] = outcome.record["verdict"]["reasons"]
    assert "along one direction" in reason["what"]
    weakest = max(outcome.record["halves"], key=lambda cut: cut["std_px"][1])
    assert f"frames before and after {weakest['frame']}, at {weakest['angle_deg']:.0f} degrees" in reason["where"]
    assert min(weakest["angle_deg"], 180 - weakest["angle_deg"]) < 5
    assert 164 < weakest["frame"] < 286
    score = corner_errors(found.homographies, true, SHAPE, found.located)
    assert np.mean(score.errors_px <= 3 * found.std_px) >= WITHIN_3


def test_error_of_the_reference_frame_is_that_of_all(tmp_path: Path, outcome_of: Callable[..., Any]) -> None:
    """The camera turns back within the middle frame, which the interpolated motion passes by: all frames lie beside it."""
    true = np.tile(np.eye(3), (N_FRAMES, 1, 1))
    true[:, 0, 2] = 20 + 0.6 * np.minimum(np.arange(N_FRAMES), N_FRAMES - 1 - np.arange(N_FRAMES))
    true[:, 1, 2] = 40 + 3 * np.sin(np.arange(N_FRAMES) / 60)
    scene = textured((150, 360), FLUX, seed=4).astype(np.float32)
    found = load_run_trajectory(outcome_of(parse_spec(spec_of(true, scene, SHAPE, tmp_path) | {"levels": 2})).directory)
    to_reference = np.linalg.inv(true[N_FRAMES // 2]) @ true
    errors_px = corner_displacements(np.linalg.inv(to_reference) @ found.homographies, np.eye(3), SHAPE).mean(axis=-1)
    assert errors_px.mean() > 0.2
    assert np.mean(errors_px <= 3 * found.std_px) >= WITHIN_3


def run_along(
    true: np.ndarray, scene: np.ndarray, shape: tuple[int, int], folder: Path, outcome_of: Callable[..., Any]
) -> tuple[float, float]:
    """Run a capture by default; return its mean error, and the share of the frames within 3 std_px: it is trusted."""
    outcome = outcome_of(parse_spec(spec_of(true, scene, shape, folder)))
    found = load_run_trajectory(outcome.directory)
    score = corner_errors(found.corner_homographies, true, shape, found.located)
    assert found.located.all()
    assert outcome.record["verdict"]["status"] == "trusted", outcome.record["verdict"]["reasons"]
    return score.mean_px, float(np.mean(score.errors_px <= 3 * found.std_px))


def spec_of(true: np.ndarray, scene: np.ndarray, shape: tuple[int, int], folder: Path) -> dict[str, Any]:
    """Write a capture; return its spec."""
    np.save(folder / "cube.npy", np.packbits(detected(seen_along(scene, true, shape), 7), axis=-1))
    return {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(folder / "cube.npy")}}}
