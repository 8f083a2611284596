from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import NotLocated

pytest.importorskip("torch")
pytest.importorskip("kornia")

from photonpano_kornia.configs import KorniaFeaturesConfig
from photonpano_kornia.matched import FeatureLocator, SiftFeatures

SHAPE = (120, 176)
STILL = np.eye(3)


def locator(**config: object) -> FeatureLocator:
    return FeatureLocator(KorniaFeaturesConfig.model_validate(config), seed=0)


@pytest.mark.parametrize("sigma_px", [2.5, 7.0])
def test_keypoints_lie_at_centres_of_blobs(photograph: Callable, sigma_px: float) -> None:
    """To less than half a pixel, also in octaves of kornia's pyramid that are finer and coarser than the image."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    middle = np.array([83.25, 61.75])
    blob = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * sigma_px**2))
    found = locator(max_keypoints=16).describe(photograph(0.2 + 2 * blob, 0))
    strongest = found.points[np.argmin(np.linalg.norm(found.points - middle, axis=1))]
    np.testing.assert_allclose(strongest, middle, atol=0.15)


def test_describe_keeps_at_most_max_keypoints_and_no_padding(shot: Callable, photograph: Callable) -> None:
    every, best = locator().describe(shot(STILL)), locator(max_keypoints=50).describe(shot(STILL))
    assert 200 < len(every.points) < 2000
    assert len(best.points) == len(best.sizes) == len(best.descriptors) == 50
    assert best.sizes.min() > 1
    assert best.shape == SHAPE


def test_describe_finds_no_keypoints_in_masked_areas(shot: Callable) -> None:
    exposure = shot(STILL)
    exposure.flux[:, :90], exposure.weight[:, :90] = np.nan, 0
    found = locator().describe(exposure)
    assert len(found.points) > 50
    assert found.points[:, 0].min() > 88


def features(points: np.ndarray) -> SiftFeatures:
    """Keypoints that match one to one, with distinct descriptors."""
    descriptors = np.random.default_rng(0).normal(size=(len(points), 128))
    frames = np.concatenate([np.tile(6 * np.eye(2), (len(points), 1, 1)), points[:, :, None]], axis=2)
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    return SiftFeatures(frames.astype(np.float32), unit.astype(np.float16), SHAPE)


def few(moving: np.ndarray, fixed: np.ndarray, initial: np.ndarray | None = None, **config: object) -> str:
    motion = locator(**config).register(features(moving), features(fixed), initial)
    assert isinstance(motion, NotLocated), motion
    return motion.reason


@pytest.mark.parametrize("matcher", ["smnn", "adalam"])
@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_too_few_keypoints_are_rejected_with_their_numbers(count: int, matcher: str) -> None:
    points = np.random.default_rng(0).uniform((0, 0), (175, 119), (count, 2))
    for initial in (None, STILL):
        assert few(points, points, initial, matcher=matcher).endswith(
            f" matches, fewer than min_inliers = 12 ({count} and {count} keypoints)"
        )


def test_matches_that_agree_by_chance_are_rejected() -> None:
    """200 outliers; more than 8 + 0.1 * 200 matches must agree."""
    points, moved = np.random.default_rng(0).uniform((0, 0), (175, 119), (2, 200, 2))
    reason = few(points, moved)
    agreeing = int(reason.split()[0])
    assert reason == f"{agreeing} of 200 matches agree on a motion, which may be chance (more than 28 must)"
    assert 4 <= agreeing <= 28


def test_keypoints_on_a_line_are_rejected() -> None:
    line = np.stack([np.linspace(10, 170, 40), np.full(40, 60.0)], axis=1)
    few(line, line + np.random.default_rng(0).normal(scale=0.3, size=line.shape))


def test_implausible_motion_is_rejected() -> None:
    """Keypoints at half their distances from the centre."""
    points = np.random.default_rng(0).uniform((0, 0), (175, 119), (60, 2))
    assert few(points, 0.5 * points + [40, 30]) == (
        "the homography changes the area of the image by a factor of 0.25 (at most 2 is plausible), from 60 matches"
    )
