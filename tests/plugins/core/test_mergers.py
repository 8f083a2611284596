"""What the conformance kit does not test of mergers: what they share with photon-mle, what they refuse, and robust-merge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Light, Merger, Source, StageContext, Trajectory, discover
from photonpano.corrections.lighting import in_light
from photonpano.geometry import Camera, translation
from photonpano.merging import accumulate, chunks_of
from photonpano.testing import KnownMotion, MemorySource

N, HEIGHT, WIDTH = 140, 60, 90
GROUP = Group(FrameSpan(0, N), (N - 1) / 2)
SPEED_PX = 0.1
SIDE = 12
CATALOG = discover()
Y, X = np.mgrid[:HEIGHT, :120]
SCENE = 0.3 + 0.12 * np.sin(X / 6) * np.cos(Y / 8) + np.where(X > 60, 0.15, 0)
"""Probabilities of a lit pixel: a smooth landscape with an edge."""


@pytest.fixture(scope="module")
def motion(pan: Callable) -> Trajectory:
    return pan(SPEED_PX)


def built(name: str, **keys: Any) -> Merger:
    contribution, source = CATALOG.find("merger", name).contribution, MemorySource(np.zeros((N, HEIGHT, WIDTH)))
    return contribution.build(contribution.config(**keys), StageContext(source.info, source.response))


def robust(**keys: float) -> Merger:
    return built("robust-merge", **{"tolerance_px": 0.25} | keys)


def plain(tolerance_px: float = 0.25) -> Merger:
    return built("photon-mle", tolerance_px=tolerance_px)


def true_view(frame: float) -> np.ndarray:
    """The view of a frame that moves along x, interpolated linearly."""
    left = SPEED_PX * frame
    whole, part = int(left), left - int(left)
    return (1 - part) * SCENE[:, whole : whole + WIDTH] + part * SCENE[:, whole + 1 : whole + 1 + WIDTH]


def with_object(view: np.ndarray, frame: float, brightness: float = 0.9) -> np.ndarray:
    """Add a square that moves by itself across half of the frame."""
    left = round(20 + 40 * frame / N)
    view = view.copy()
    view[24 : 24 + SIDE, left : left + SIDE] = brightness
    return view


def capture(seed: int = 0, crossed: bool = False) -> MemorySource:
    rng = np.random.default_rng(seed)
    views = [with_object(true_view(frame), frame) if crossed else true_view(frame) for frame in range(N)]
    return MemorySource(np.array([rng.random(view.shape) < view for view in views]))


def mean_count(merger: Merger, source: Source, motion: Trajectory | None) -> np.ndarray:
    exposure = merger.merge(source, GROUP, motion, 1.0)
    return exposure.response.mean_count(exposure.flux)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("name", ["robust-merge", "splat"])
def test_mergers_equal_photon_mle_without_trajectory(name: str, scale: float) -> None:
    """Motion of camera and scene are not separable there."""
    source = capture(crossed=True)
    source.valid = np.random.default_rng(1).random((HEIGHT, WIDTH)) > 0.05
    exposure, other = (each.merge(source, GROUP, None, scale) for each in (built(name), plain()))
    np.testing.assert_array_equal(exposure.flux, other.flux)
    np.testing.assert_array_equal(exposure.weight, other.weight)


@pytest.mark.parametrize("name", ["photon-mle", "robust-merge", "burst", "local-flow"])
def test_group_of_one_frame_is_that_frame(name: str, motion: Trajectory) -> None:
    source = capture()
    exposure = built(name).merge(source, Group(FrameSpan(3, 4), 3.0), motion, 1.0)
    np.testing.assert_allclose(exposure.weight, 1, rtol=1e-4)
    np.testing.assert_array_equal(exposure.flux > 0.3, source.frames(FrameSpan(3, 4))[0] > 0)


@pytest.mark.parametrize(("name", "instead"), [("burst", "photon-mle"), ("local-flow", "robust-merge")])
def test_changing_light_and_a_lens_that_distorts_are_errors(
    name: str, instead: str, motion: Trajectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = capture()
    with pytest.raises(InputError, match=rf"{name} does not divide by light that changes; use {instead}"):
        built(name).merge(in_light(source, Light.of_frames(np.ones(N))), GROUP, motion, 1.0)
    monkeypatch.setattr(source, "camera", Camera.of(100.0, (HEIGHT, WIDTH), (-0.1, 0, 0, 0)), raising=False)
    with pytest.raises(InputError, match=rf"{name} does not warp through a lens that distorts; use {instead}"):
        built(name).merge(source, GROUP, motion, 1.0)


@pytest.mark.parametrize("tolerance_px", [0.25, 4.0])
def test_photon_mle_sums_chunks_within_tolerance(tolerance_px: float, motion: Trajectory) -> None:
    source, to_reference = capture(), translation(-SPEED_PX * GROUP.reference, 0)
    chunks = chunks_of(GROUP.span, motion, (HEIGHT, WIDTH), tolerance_px)
    expected, _ = accumulate(source, chunks, to_reference, (HEIGHT, WIDTH)).estimate(source.response)
    exposure = plain(tolerance_px).merge(source, GROUP, motion, 1.0)
    np.testing.assert_allclose(exposure.flux, expected, atol=1e-3)


def test_robust_merge_is_as_exact_as_photon_mle_on_static_scene(motion: Trajectory) -> None:
    """Over many captures the variance is within 2 % of that of all photons, and there is no additional bias."""
    found: list[list[np.ndarray]] = [[], []]
    weights = []
    for seed in range(30):
        source = capture(seed)
        for merger, images in zip((robust(), plain()), found, strict=True):
            images.append(mean_count(merger, source, motion)[5:-5, 10:-10])
        weights.append(robust().merge(source, GROUP, motion, 1.0).weight[5:-5, 10:-10])
    variances, means = ([statistic(images, axis=0) for images in found] for statistic in (np.var, np.mean))
    assert variances[0].mean() < 1.02 * variances[1].mean()
    assert np.mean(weights) > 0.985 * N
    standard_error = np.sqrt(variances[1].mean() / 30)
    assert np.sqrt(np.mean((means[0] - means[1]) ** 2)) < 0.3 * standard_error
    assert abs(np.mean(means[0] - means[1])) < 0.01 * standard_error


def test_robust_merge_leaves_no_ghost_of_moving_object(motion: Trajectory) -> None:
    source = capture(crossed=True)
    true = with_object(true_view(GROUP.reference), GROUP.reference)
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


def test_robust_merge_reduces_weight_at_moving_object(motion: Trajectory) -> None:
    weight = robust().merge(capture(crossed=True), GROUP, motion, 1.0).weight
    assert weight[4:14, 10:-10].mean() > 0.97 * N
    # The blocks in which the object is elsewhere do not count where it is now: about one in seven does.
    assert weight[28:32, 44:48].mean() < 0.5 * N
    assert weight[5:-5, 10:-10].min() >= N / 7 - 1e-3


@pytest.mark.parametrize(("scale", "shape"), [(0.5, (30, 45)), (2.0, (120, 180))])
def test_robust_merge_keeps_weight_at_other_scales(motion: Trajectory, scale: float, shape: tuple[int, int]) -> None:
    exposure, other = (each.merge(capture(), GROUP, motion, scale) for each in (robust(), plain()))
    assert exposure.flux.shape == shape
    assert exposure.flux.dtype == exposure.weight.dtype == np.float32
    assert exposure.weight.mean() > 0.98 * other.weight.mean()


def test_robust_merge_keeps_borders_outside_of_reference_block(motion: Trajectory) -> None:
    found, other = (each.merge(capture(), Group(FrameSpan(0, N), 0.0), motion, 1.0) for each in (robust(), plain()))
    np.testing.assert_array_equal(np.isnan(found.flux), np.isnan(other.flux))
    np.testing.assert_allclose(found.weight[5:-5, -2:], other.weight[5:-5, -2:], rtol=0.05, atol=1)


def test_robust_merge_tolerates_small_motion_error() -> None:
    """The motion is 0.5 px off at the ends of the group, so that edges differ by more than noise."""
    wrong = KnownMotion(lambda frame: translation(SPEED_PX * frame + 0.5 * (abs(frame - 70) > 50), 0))
    tolerant, strict = (robust(tolerated_px=each, tolerated_std=2).merge(capture(), GROUP, wrong, 1.0) for each in (1.0, 0.0))
    assert tolerant.weight[5:-5, 10:-10].mean() > strict.weight[5:-5, 10:-10].mean()
