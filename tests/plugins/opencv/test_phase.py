from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import Located, NotLocated
from photonpano.geometry import apply, from_parameters, generators, jacobian, translation
from photonpano.locating import View
from photonpano_opencv.brightness import PhaseCorrelationLocator
from photonpano_opencv.configs import PhaseCorrelationConfig

SHAPE = (160, 240)
STILL = np.eye(3)
LOCATOR = PhaseCorrelationLocator(PhaseCorrelationConfig())


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
    motion = LOCATOR.register(waves(0, 0), waves(x_px, y_px), None)
    assert isinstance(motion, Located), motion
    np.testing.assert_allclose(motion.homography, translation(x_px, y_px), atol=0.2)


def test_phase_correlation_drops_roll_and_perspective_of_initial_motion(seen_from: Callable) -> None:
    """Otherwise their errors, which no pair measures, would be fed back from level to level."""
    true = translation(37, -11)
    known = true @ from_parameters([0.01, 0.004, -0.006, 0.02, 2, -3, 2e-5, -3e-5])
    exposures = LOCATOR.describe(seen_from(true, 1)), LOCATOR.describe(seen_from(STILL, 2))
    for initial in (known / known[2, 2], None):
        motion = LOCATOR.register(*exposures, initial)
        assert isinstance(motion, Located)
        np.testing.assert_array_equal(motion.homography[:, :2], STILL[:, :2])
        np.testing.assert_allclose(motion.homography, true, atol=0.1)


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
        motion = LOCATOR.register(
            LOCATOR.describe(seen_from(true, 2 * seed)), LOCATOR.describe(seen_from(STILL, 2 * seed + 1)), None
        )
        assert isinstance(motion, Located), motion
        errors.append(np.sum((apply(motion.homography, points) - apply(true, points)) ** 2, axis=1))
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
        pair = (LOCATOR.describe(seen_from(each, 2 * seed + i, brightness)) for i, each in enumerate((true, STILL)))
        motion = LOCATOR.register(*pair, None)
        assert isinstance(motion, Located), motion
        errors.append(np.sum((motion.homography - true) ** 2))
        predicted.append(np.trace(np.linalg.inv(motion.information[4:6, 4:6])))
    assert 0.5 < np.sqrt(np.mean(errors) / np.mean(predicted)) < 2


def test_phase_correlation_rejects_roll_of_17_degrees(seen_from: Callable) -> None:
    roll = from_parameters([np.cos(0.3) - 1, np.sin(0.3), -np.sin(0.3), np.cos(0.3) - 1, 25, -30, 0, 0])
    motion = LOCATOR.register(LOCATOR.describe(seen_from(roll, 1)), LOCATOR.describe(seen_from(STILL, 2)), None)
    assert isinstance(motion, NotLocated)
    assert "the similarity of the images" in motion.reason
