"""What the conformance kit does not test of the locators of OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import corner_displacements, from_parameters, generators, jacobian, transform_points, translation
from photonpano.locating import View
from photonpano_opencv.hooks import OpencvEccConfig, OpencvOrbConfig, PhaseCorrelationConfig
from photonpano_opencv.locators import (
    EccLocator,
    Keypoints,
    OrbLocator,
    PhaseCorrelationLocator,
    match_everywhere,
    unit_descriptors,
)

SHAPE = (160, 240)
STILL = np.eye(3)
ECC = EccLocator(OpencvEccConfig())
PHASE = PhaseCorrelationLocator(PhaseCorrelationConfig())


def register(
    locator: EccLocator | PhaseCorrelationLocator, moving: VirtualExposure, fixed: VirtualExposure
) -> Located | NotLocated:
    return locator.register(locator.describe(moving), locator.describe(fixed), None)


def test_ecc_locates_pair_of_different_brightness_with_less_certainty(seen_from: Callable) -> None:
    """The correlation coefficient does not depend on brightness; the expected error does."""
    true = translation(10, -3)
    equal, dimmed = (register(ECC, seen_from(true, 1), seen_from(STILL, 2, brightness)) for brightness in (1.0, 0.7))
    for motion in (equal, dimmed):
        assert isinstance(motion, Located), motion
        assert corner_displacements(motion.homography, true, SHAPE).mean() < 0.15
    assert dimmed.residual_px > 2 * equal.residual_px


def test_ecc_reports_error_of_opencv_as_reason(seen_from: Callable) -> None:
    """From an initial motion without overlap OpenCV raises on every layer."""
    pair = (ECC.describe(seen_from(each, seed)) for seed, each in enumerate((STILL, STILL)))
    motion = ECC.register(*pair, translation(235, 0))
    assert isinstance(motion, NotLocated)
    assert motion.reason == "the correlation cannot be maximised: NaN encountered"


def described(exposure: object, **config: object) -> Keypoints:
    return OrbLocator(OpencvOrbConfig.model_validate(config), seed=0).describe(exposure)


def test_keypoints_of_coarse_levels_are_not_off_by_half_a_pixel(seen_from: Callable) -> None:
    """The keypoints of an exposure turned by 180 degrees are those of the exposure, turned."""
    exposure = seen_from(np.eye(3))
    here = described(exposure)
    turned = described(replace(exposure, flux=exposure.flux[::-1, ::-1].copy(), weight=exposure.weight[::-1, ::-1].copy()))
    back = np.array([SHAPE[1] - 1, SHAPE[0] - 1]) - turned.points
    offsets = []
    for point, size in zip(here.points, here.sizes, strict=True):
        distances = np.linalg.norm(back - point, axis=1)
        distances[turned.sizes != size] = np.inf
        if size > 31 * 1.2**2.5 and distances.min() < 2:
            offsets.append(back[distances.argmin()] - point)
    assert len(offsets) > 50
    # Where OpenCV says that they are, it is half a pixel.
    assert np.abs(np.mean(offsets, axis=0)).max() < 0.1


def waves(x_px: float, y_px: float) -> View:
    """A sum of 40 plane waves, shifted: band-limited, so that the shift is exact."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:80, :120]
    image = np.zeros(x.shape)
    for fx, fy, phase in rng.uniform(-0.1, 0.1, (40, 3)) * [1, 1, 30]:
        image += np.cos(2 * np.pi * (fx * (x - x_px) + fy * (y - y_px)) + phase)
    return View(image.astype(np.float32), np.ones(image.shape, np.float32), 1.0)


@settings(max_examples=30, deadline=None)
@given(x_px=st.floats(-8, 8), y_px=st.floats(-8, 8))
def test_phase_correlation_finds_sub_pixel_shifts(x_px: float, y_px: float) -> None:
    motion = PHASE.register(waves(0, 0), waves(x_px, y_px), None)
    assert isinstance(motion, Located), motion
    np.testing.assert_allclose(motion.homography, translation(x_px, y_px), atol=0.2)


def test_information_predicts_errors_if_camera_also_rolls(seen_from: Callable) -> None:
    """Over 20 pairs with six other parameters drawn from the prior, to a factor of 2.5, in the centre and at the corners."""
    rng = np.random.default_rng(3)
    points = np.array([[119.5, 79.5], [0, 0], [239, 159]])
    errors, predicted = [], []
    for seed in range(20):
        p = rng.normal(0, 0.01, 8)
        p[4:6] = 0
        true = translation(4, 3) @ (STILL + np.tensordot(p, generators(SHAPE), 1))
        true /= true[2, 2]
        motion = register(PHASE, seen_from(true, 2 * seed), seen_from(STILL, 2 * seed + 1))
        assert isinstance(motion, Located), motion
        errors.append(np.sum((transform_points(motion.homography, points) - transform_points(true, points)) ** 2, axis=1))
        j = jacobian(motion.homography, points)
        predicted.append(np.trace(j @ np.linalg.inv(motion.information) @ j.transpose(0, 2, 1), axis1=1, axis2=2))
    # The parameters have a third of the standard deviation of the prior, so that the pairs are accepted.
    ratio = 3 * np.sqrt(np.mean(errors, axis=0) / np.mean(predicted, axis=0))
    assert np.all((ratio > 0.4) & (ratio < 2.5)), ratio


@pytest.mark.parametrize("brightness", [1.0, 0.1])
def test_information_predicts_errors_of_pure_shifts(seen_from: Callable, brightness: float) -> None:
    """Over 12 pairs; p5 and p6 with the other parameters held."""
    true = translation(10, -3)
    errors, predicted = [], []
    for seed in range(12):
        motion = register(PHASE, *(seen_from(each, 2 * seed + i, brightness) for i, each in enumerate((true, STILL))))
        assert isinstance(motion, Located), motion
        errors.append(np.sum((motion.homography - true) ** 2))
        predicted.append(np.trace(np.linalg.inv(motion.information[4:6, 4:6])))
    assert 0.5 < np.sqrt(np.mean(errors) / np.mean(predicted)) < 2


def test_phase_correlation_rejects_roll_of_17_degrees(seen_from: Callable) -> None:
    roll = from_parameters([np.cos(0.3) - 1, np.sin(0.3), -np.sin(0.3), np.cos(0.3) - 1, 25, -30, 0, 0])
    motion = register(PHASE, seen_from(roll, 1), seen_from(STILL, 2))
    assert isinstance(motion, NotLocated)
    assert "the similarity of the images" in motion.reason


counts = st.integers(0, 12)
seeds = st.integers(0, 2**32 - 1)


def descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Descriptors of few values, so that there are near ties and distinct matches."""
    return unit_descriptors(rng.integers(0, 4, (count, 128), dtype=np.uint8) ** rng.integers(1, 5, (count, 1), dtype=np.uint8))


def chosen(moving: np.ndarray, fixed: np.ndarray, allowed: np.ndarray, ratio: float) -> set[tuple[int, int]]:
    """Match pair by pair: mutual nearest neighbours that pass Lowe's ratio test."""
    distance = np.where(allowed, np.sqrt(np.maximum(2 - 2 * moving.astype(float) @ fixed.T.astype(float), 0)), np.inf)
    pairs = set()
    for i in range(len(moving)):
        if not allowed[i].any():
            continue
        j = int(distance[i].argmin())
        others = np.delete(distance[i], j)
        second = others.min() if np.isfinite(others).any() else 2.0
        if distance[:, j].argmin() == i and distance[i, j] <= ratio * second:
            pairs.add((i, j))
    return pairs


@given(n_moving=counts, n_fixed=counts, seed=seeds)
def test_match_everywhere_keeps_mutual_distinct_matches(n_moving: int, n_fixed: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = descriptors(rng, n_moving), descriptors(rng, n_fixed)
    pairs = match_everywhere(moving, fixed, 0.95)
    assert pairs.shape == (len(pairs), 2)
    if min(n_moving, n_fixed) < 2:
        assert len(pairs) == 0
    else:
        assert {tuple(pair) for pair in pairs} == chosen(moving, fixed, np.ones((n_moving, n_fixed), bool), 0.95)
