from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import corner_displacements, from_parameters, parameters, transform_points
from photonpano.locating.points import MIN_NOISE_PX, fit_homography

SHAPE = (160, 240)
TRUE = from_parameters([0.03, -0.02, 0.01, -0.04, 12, 9, 1e-4, -5e-5])
SIZES = np.full(120, 4, np.float32)


def matches(seed: int, std_px: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), (239, 159), (len(SIZES), 2))
    return points.astype(np.float32), (transform_points(TRUE, points) + rng.normal(size=points.shape) * std_px).astype(
        np.float32
    )


def error_px(homography: np.ndarray) -> float:
    return float(corner_displacements(homography, TRUE, SHAPE).mean())


def test_fit_is_exact_without_noise() -> None:
    fit = fit_homography(*matches(0), SIZES, np.eye(3))
    assert error_px(fit.homography) < 1e-4
    assert fit.residual_px == MIN_NOISE_PX


def test_information_predicts_scatter_of_100_fits() -> None:
    """With errors of 0.3 px: chi squared of eight parameters has the mean 8."""
    chi_squared = []
    for seed in range(100):
        fit = fit_homography(*matches(seed, 0.3), SIZES, TRUE)
        error = parameters(fit.homography) - parameters(TRUE)
        chi_squared.append(error @ fit.information @ error)
    assert np.mean(chi_squared) == pytest.approx(8, rel=0.2)


def test_rounding_px_keeps_common_error_in_information() -> None:
    """Over 100 fits to matches with a common error of about 0.3 px and little scatter."""
    chi_squared = []
    for seed in range(100):
        here, there = matches(seed, 0.05)
        there += np.random.default_rng(seed).normal(0, 0.3, 2)
        fit = fit_homography(here, there, SIZES, TRUE, rounding_px=0.3)
        error = parameters(fit.homography) - parameters(TRUE)
        chi_squared.append(error @ fit.information @ error)
    assert np.mean(chi_squared) == pytest.approx(8, rel=0.2)


def test_fit_is_robust_against_a_quarter_of_outliers() -> None:
    here, there = matches(0, 0.3)
    clean = fit_homography(here, there, SIZES, TRUE)
    there[:30] += np.random.default_rng(1).uniform(-4, 4, (30, 2)).astype(np.float32)
    wrong = fit_homography(here, there, SIZES, TRUE)
    assert error_px(wrong.homography) < 2.5 * error_px(clean.homography) + 0.05
    # The outliers are unknown, so the residual is larger.
    assert 2 * clean.residual_px < wrong.residual_px < 1.5


def test_weights_by_keypoint_size_lower_the_error() -> None:
    """For position errors proportional to the sizes."""
    sizes = np.tile(np.float32([2, 20]), 60)
    errors = []
    for weighted in (sizes, SIZES):
        fits = [fit_homography(*matches(seed, 0.05 * sizes[:, None]), weighted, TRUE) for seed in range(10)]
        errors.append(np.mean([error_px(fit.homography) for fit in fits]))
    assert errors[0] < 0.6 * errors[1]


def test_corner_std_px_predicts_scatter_of_corners() -> None:
    fit = fit_homography(*matches(0, 0.3), SIZES, TRUE)
    errors = [
        corner_displacements(fit_homography(*matches(seed, 0.3), SIZES, TRUE).homography, TRUE, SHAPE) for seed in range(50)
    ]
    worst = np.sqrt(np.mean(np.square(errors), axis=0)).max()
    assert fit.corner_std_px(SHAPE) == pytest.approx(worst, rel=0.4)


def test_corner_std_px_is_large_for_points_on_a_line() -> None:
    line = np.stack([np.linspace(0, 200, 120), np.full(120, 50.0)], axis=1).astype(np.float32)
    assert fit_homography(line, line, SIZES, np.eye(3)).corner_std_px(SHAPE) > 1e3
