from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, LocationError, PosedView, PoseEstimate, ScenePoints
from photonpano.geometry import camera_matrix
from photonpano.testing import PoseEstimatorConformance
from photonpano.testing.pose_estimators import FOCAL_PX, N_FRAMES, SHAPE, capture, true_poses


def true_estimate() -> PoseEstimate:
    """Return the true poses, with errors of 1 mm and 0.01 degrees."""
    poses = true_poses()
    poses[:, :, 3] += 0.001 * np.random.default_rng(0).normal(size=(N_FRAMES, 3))
    ones, span = np.ones(N_FRAMES), FrameSpan(0, 10)
    nothing = np.zeros(0, np.intp), np.zeros((0, 2))
    view = PosedView(span, 4.0, poses[4], *nothing, lambda: np.zeros(SHAPE, np.float32))
    points = ScenePoints(np.zeros((0, 3)), np.zeros(0, np.float32))
    matrix = camera_matrix(FOCAL_PX, (79.5, 63.5))
    return PoseEstimate(
        matrix, np.zeros(4), 0.0, poses, ones > 0, 0.001 * np.sqrt(3) * ones, 0.01 * ones, points, (view,), (), (), ()
    )


def estimator(change: Callable[[PoseEstimate], Any] = lambda it: it, refuses_turns: bool = True) -> Any:
    def estimate(source: Any, camera: Any, progress: Any) -> Any:
        if refuses_turns and source is capture(False):
            raise LocationError("it only turns")
        return change(true_estimate())

    return lambda _: SimpleNamespace(estimate=estimate)


def test_true_poses_pass_every_check(failure: Callable[..., str | None], checks_of: Callable[..., set[str]]) -> None:
    from photonpano.testing.stages import StageConformance

    for check in checks_of(PoseEstimatorConformance, beside=StageConformance):
        assert failure(PoseEstimatorConformance, check, estimator()) is None, check


def no_identity(it: PoseEstimate) -> PoseEstimate:
    poses = it.camera_from_world.copy()
    poses[100:] = np.eye(3, 4)
    return replace(it, camera_from_world=poses, located=np.arange(N_FRAMES) < 100)


@pytest.mark.parametrize(
    ("check", "change", "words"),
    [
        ("test_estimate_finds_the_poses", no_identity, "a run refuses .* must be NaN where a frame is not located"),
        (
            "test_estimate_finds_the_poses",
            lambda it: replace(it, camera_from_world=np.roll(it.camera_from_world, 80, axis=0)),
            "positions err by",
        ),
        (
            "test_estimate_finds_the_poses",
            lambda it: replace(it, std_position=it.std_position / 10),
            r"errors of positions are 9\.\d times std_position",
        ),
        (
            "test_estimate_finds_the_poses",
            lambda it: replace(it, camera_matrix=camera_matrix(99.0, (79.5, 63.5))),
            "a focal length that is given must be kept",
        ),
    ],
)
def test_kit_catches(catches: Callable[..., None], check: str, change: Callable[[PoseEstimate], Any], words: str) -> None:
    catches(PoseEstimatorConformance, check, estimator(change), words)


def test_kit_catches_poses_of_a_camera_that_only_turns(catches: Callable[..., None]) -> None:
    check = "test_camera_that_only_turns_has_no_poses"
    catches(PoseEstimatorConformance, check, estimator(refuses_turns=False), "raise a LocationError that says so")


def test_kit_catches_other_poses_each_time(catches: Callable[..., None]) -> None:
    numbers = count()

    def moved(it: PoseEstimate) -> PoseEstimate:
        poses = it.camera_from_world.copy()
        poses[:, :, 3] += next(numbers)
        return replace(it, camera_from_world=poses)

    words = "found other poses for the same capture and seed"
    catches(PoseEstimatorConformance, "test_estimate_is_deterministic", estimator(moved), words)
