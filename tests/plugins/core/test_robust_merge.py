from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Source, Trajectory
from photonpano.geometry import translation
from photonpano_core.configs import PhotonMleConfig, RobustMergeConfig
from photonpano_core.mergers.photon_mle import PhotonMleMerger
from photonpano_core.mergers.robust_merge import RobustMerger

N, HEIGHT, WIDTH = 140, 60, 90
GROUP = Group(FrameSpan(0, N), (N - 1) / 2)
SPEED_PX = 0.1
SIDE = 12


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """(60, 120) probabilities of a lit pixel: a smooth landscape with an edge."""
    y, x = np.mgrid[:HEIGHT, :120]
    return 0.3 + 0.12 * np.sin(x / 6) * np.cos(y / 8) + np.where(x > 60, 0.15, 0)


@pytest.fixture(scope="module")
def motion(pan: Callable) -> Trajectory:
    return pan(SPEED_PX)


def true_view(scene: np.ndarray, frame: float) -> np.ndarray:
    """The view of a frame that moves along x, interpolated linearly."""
    left = SPEED_PX * frame
    whole, part = int(left), left - int(left)
    return (1 - part) * scene[:, whole : whole + WIDTH] + part * scene[:, whole + 1 : whole + 1 + WIDTH]


def with_object(view: np.ndarray, frame: float, brightness: float = 0.9) -> np.ndarray:
    """Add a square that moves by itself across half of the frame."""
    left = round(20 + 40 * frame / N)
    view = view.copy()
    view[24 : 24 + SIDE, left : left + SIDE] = brightness
    return view


def capture(memory_source: type, scene: np.ndarray, seed: int, crossed: bool, valid: np.ndarray | None = None) -> Source:
    rng = np.random.default_rng(seed)
    views = [true_view(scene, frame) for frame in range(N)]
    if crossed:
        views = [with_object(view, frame) for frame, view in enumerate(views)]
    return memory_source(np.array([rng.random(view.shape) < view for view in views]), valid)


def robust(**config: float) -> RobustMerger:
    return RobustMerger(RobustMergeConfig.model_validate({"tolerance_px": 0.25} | config))


def plain() -> PhotonMleMerger:
    return PhotonMleMerger(PhotonMleConfig(tolerance_px=0.25))


def mean_count(merger: RobustMerger | PhotonMleMerger, source: Source, motion: Trajectory | None) -> np.ndarray:
    exposure = merger.merge(source, GROUP, motion, 1.0)
    return exposure.response.mean_count(exposure.flux)


def test_robust_merge_is_as_exact_as_photon_mle_on_static_scene(
    memory_source: type, scene: np.ndarray, motion: Trajectory
) -> None:
    """Over many captures the variance is within 2 % of that of all photons, and there is no additional bias."""
    found = {merger: [] for merger in (robust(), plain())}
    weights = []
    for seed in range(30):
        source = capture(memory_source, scene, seed, crossed=False)
        for merger, images in found.items():
            images.append(mean_count(merger, source, motion)[5:-5, 10:-10])
        weights.append(robust().merge(source, GROUP, motion, 1.0).weight[5:-5, 10:-10])
    variances, means = ([statistic(images, axis=0) for images in found.values()] for statistic in (np.var, np.mean))
    assert variances[0].mean() < 1.02 * variances[1].mean()
    assert np.mean(weights) > 0.985 * N
    standard_error = np.sqrt(variances[1].mean() / 30)
    assert np.sqrt(np.mean((means[0] - means[1]) ** 2)) < 0.3 * standard_error
    assert abs(np.mean(means[0] - means[1])) < 0.01 * standard_error


def test_robust_merge_leaves_no_ghost_of_moving_object(memory_source: type, scene: np.ndarray, motion: Trajectory) -> None:
    source = capture(memory_source, scene, 0, crossed=True)
    true = with_object(true_view(scene, GROUP.reference), GROUP.reference)
    # Where the object was at other times.
    ghost = np.zeros((HEIGHT, WIDTH), bool)
    ghost[24 : 24 + SIDE, 20 : 60 + SIDE] = True
    ghost[:, 36 : 44 + SIDE] = False
    errors = [np.sqrt(np.mean((mean_count(each, source, motion) - true)[ghost] ** 2)) for each in (robust(), plain())]
    assert errors[0] < 0.5 * errors[1]
    # And the object itself is seen, not smeared.
    inside = (slice(27, 24 + SIDE - 3), slice(44, 48))
    objects = [mean_count(each, source, motion)[inside].mean() for each in (robust(), plain())]
    assert objects[0] > 0.8
    assert objects[1] < 0.7


def test_robust_merge_reduces_weight_at_moving_object(memory_source: type, scene: np.ndarray, motion: Trajectory) -> None:
    weight = robust().merge(capture(memory_source, scene, 0, crossed=True), GROUP, motion, 1.0).weight
    assert weight[4:14, 10:-10].mean() > 0.97 * N
    # The blocks in which the object is elsewhere do not count where it is now: about one in seven does.
    assert weight[28:32, 44:48].mean() < 0.5 * N
    assert weight[5:-5, 10:-10].min() >= N / 7 - 1e-3


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_robust_merge_equals_photon_mle_without_trajectory(memory_source: type, scene: np.ndarray, scale: float) -> None:
    """Motion of camera and scene are not separable there."""
    source = capture(memory_source, scene, 0, crossed=True)
    exposure, other = (each.merge(source, GROUP, None, scale) for each in (robust(), plain()))
    np.testing.assert_array_equal(exposure.flux, other.flux)
    np.testing.assert_array_equal(exposure.weight, other.weight)


@pytest.mark.parametrize(("scale", "shape"), [(0.5, (30, 45)), (2.0, (120, 180))])
def test_robust_merge_keeps_weight_at_other_scales(
    memory_source: type, scene: np.ndarray, motion: Trajectory, scale: float, shape: tuple[int, int]
) -> None:
    source = capture(memory_source, scene, 0, crossed=False)
    exposure, other = (each.merge(source, GROUP, motion, scale) for each in (robust(), plain()))
    assert exposure.flux.shape == shape
    assert exposure.flux.dtype == exposure.weight.dtype == np.float32
    assert exposure.weight.mean() > 0.98 * other.weight.mean()


def test_robust_merge_ignores_masked_pixels(memory_source: type, scene: np.ndarray, motion: Trajectory) -> None:
    """Hot pixels leave no trail, and pixels that no frame saw are unknown."""
    valid = np.random.default_rng(9).random((HEIGHT, WIDTH)) > 0.02
    valid[:8] = False
    hot = capture(memory_source, scene, 0, False, valid)
    hot._frames[:, ~valid] = 1
    dark = capture(memory_source, scene, 0, False, valid)
    dark._frames[:, ~valid] = 0
    found, other = (robust().merge(source, GROUP, motion, 1.0) for source in (hot, dark))
    np.testing.assert_array_equal(found.flux, other.flux)
    np.testing.assert_array_equal(np.isnan(found.flux), found.weight == 0)
    assert np.isnan(found.flux[:7]).all()
    assert found.weight[20:40, 20:70].mean() > 0.95 * N


def test_robust_merge_keeps_borders_outside_of_reference_block(
    memory_source: type, scene: np.ndarray, motion: Trajectory
) -> None:
    source = capture(memory_source, scene, 0, crossed=False)
    group = Group(FrameSpan(0, N), 0.0)
    found, other = (each.merge(source, group, motion, 1.0) for each in (robust(), plain()))
    np.testing.assert_array_equal(np.isnan(found.flux), np.isnan(other.flux))
    np.testing.assert_allclose(found.weight[5:-5, -2:], other.weight[5:-5, -2:], rtol=0.05, atol=1)


def test_robust_merge_tolerates_small_motion_error(memory_source: type, scene: np.ndarray, known_motion: type) -> None:
    """The motion is 0.5 px off at the ends of the group, so that edges differ by more than noise."""
    wrong = known_motion(lambda frame: translation(SPEED_PX * frame + 0.5 * (abs(frame - 70) > 50), 0))
    source = capture(memory_source, scene, 0, crossed=False)
    tolerant, strict = (robust(tolerated_px=each, tolerated_std=2).merge(source, GROUP, wrong, 1.0) for each in (1.0, 0.0))
    assert tolerant.weight[5:-5, 10:-10].mean() > strict.weight[5:-5, 10:-10].mean()


def test_robust_merge_of_one_frame_is_that_frame(memory_source: type, scene: np.ndarray, motion: Trajectory) -> None:
    source = capture(memory_source, scene, 0, crossed=False)
    exposure = robust().merge(source, Group(FrameSpan(3, 4), 3.0), motion, 1.0)
    np.testing.assert_allclose(exposure.weight, 1, rtol=1e-5)
