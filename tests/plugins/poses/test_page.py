"""Views of poses in perspective."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from photonpano_poses import PoseEstimate, ScenePoints
from photonpano_poses.page import path_views, scene_views

SHAPE, N_FRAMES = (90, 120), 60
MATRIX = np.array([[100.0, 0, 59.5], [0, 100, 44.5], [0, 0, 1]])


def facing_ahead(places: np.ndarray) -> np.ndarray:
    """Return poses (N, 3, 4) of cameras that look along z from places (N, 3)."""
    return np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -places[:, :, None]], axis=2)


@pytest.fixture
def estimate_of() -> Callable[..., PoseEstimate]:
    """Make an estimate of a camera that moves to the right and rises, before points; some frames may be lost."""

    def estimate_of(lost: slice = slice(0), straight: bool = False, n_points: int = 200) -> PoseEstimate:
        times = np.linspace(0, 1, N_FRAMES)
        bend = 0 * times if straight else 0.1 * np.sin(5 * times)
        poses = facing_ahead(np.stack([times, bend, 0.3 * bend * times], axis=1))
        located = np.ones(N_FRAMES, bool)
        located[lost] = False
        poses[~located] = np.nan
        std = np.where(located, 0.01, np.nan)
        rng = np.random.default_rng(2)
        points = ScenePoints(
            rng.uniform([-1, -0.5, 2], [1, 0.5, 6], (n_points, 3)), rng.uniform(0, 1, n_points).astype(np.float32)
        )
        return PoseEstimate(MATRIX, np.zeros(4), 0.0, poses, located, std, std, points, (), (), ())

    return estimate_of


@pytest.mark.parametrize("straight", [False, True])
def test_views_name_their_ends_and_sides(estimate_of: Callable[..., PoseEstimate], straight: bool) -> None:
    estimate = estimate_of(lost=slice(50, None), straight=straight)
    for view in (*path_views(estimate, SHAPE), *scene_views(estimate, SHAPE)):
        texts = re.findall(r"<text[^>]*>([^<]*)</text>", view)
        assert {"frame 0", "frame 49"} <= set(texts)
        assert len([text for text in texts if text.startswith("from ")]) == 1
        assert not re.search(r"\b(nan|inf)\b", re.sub(r"base64,[^\"]*", "", view))
