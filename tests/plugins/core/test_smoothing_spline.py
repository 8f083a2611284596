from __future__ import annotations

import numpy as np
import pytest

from photonpano import Trajectory
from photonpano.geometry import corner_displacements, corners, from_parameters, jacobian, parameters

FRAME_SHAPE = (254, 496)


def parabola(frames: np.ndarray) -> np.ndarray:
    """A motion that is a parabola in each parameter."""
    t = np.asarray(frames)[:, None] / 3000
    start = np.array([1e-2, 2e-2, -1e-2, 1e-2, 200, -50, 1e-5, 2e-5])
    return from_parameters(start * (t - 0.7 * np.array([1, -1, 2, 1, 0.5, 3, 1, -2]) * t**2))


def to_corners(homographies: np.ndarray) -> np.ndarray:
    """Return the derivatives of the corners by p1..p8: (N, 8, 8)."""
    return np.array([jacobian(homography, corners(FRAME_SHAPE)).reshape(8, 8) for homography in homographies])


def noisy(homographies: np.ndarray, std_px: np.ndarray | float, seed: int = 0) -> np.ndarray:
    """Add errors in px, which broadcast to (N, 8), to the coordinates of the corners."""
    drawn = np.random.default_rng(seed).normal(size=(len(homographies), 8)) * std_px
    return from_parameters(parameters(homographies) + np.linalg.solve(to_corners(homographies), drawn[..., None])[..., 0])


def information(homographies: np.ndarray, std_px: np.ndarray | float) -> np.ndarray:
    """Return the (N, 8, 8) information of knots whose corners have these errors in px."""
    slopes = to_corners(homographies) / np.broadcast_to(std_px, (len(homographies), 8))[..., None]
    return slopes.transpose(0, 2, 1) @ slopes


def rms_px(trajectory: Trajectory, truth: np.ndarray, frames: np.ndarray) -> float:
    """Return the root mean square error of a coordinate of a corner."""
    moved = corner_displacements(trajectory.at(frames), truth, FRAME_SHAPE)
    return float(np.sqrt(np.mean(moved**2) / 2))


def test_smoothing_spline_reduces_noise_on_parabola_to_its_fit(fit):
    """The fit has three parameters for N knots: the error falls by sqrt(N / 3), or slightly less."""
    instants = np.arange(80) * 40.0
    truth = parabola(instants)
    left = []
    for seed in range(3):
        knots = noisy(truth, 0.3, seed)
        assert rms_px(fit("lucas-kanade", instants, knots), truth, instants) == pytest.approx(0.3, rel=0.15)
        left.append(rms_px(fit("smoothing-spline", instants, knots), truth, instants))
    expected = 0.3 * np.sqrt(3 / 80)
    assert 0.8 * expected < np.mean(left) < 1.5 * expected


def test_smoothing_spline_weights_knots_by_information(fit):
    """Every second knot is ten times worse; the good ones alone give sqrt(3 / 40) of their error."""
    instants = np.arange(80) * 40.0
    truth = parabola(instants)
    std = np.where(np.arange(80)[:, None] % 2, [1.0] * 8, 0.1)
    known, unknown = [], []
    for seed in range(3):
        knots = noisy(truth, std, seed)
        known.append(rms_px(fit("smoothing-spline", instants, knots, information(truth, std)), truth, instants))
        unknown.append(rms_px(fit("smoothing-spline", instants, knots), truth, instants))
    expected = 0.1 * np.sqrt(3 / 40)
    assert 0.8 * expected < np.mean(known) < 1.5 * expected
    assert np.mean(unknown) > 3 * np.mean(known)


def test_smoothing_spline_weights_directions_by_information(fit):
    """Even knots have information on x but not on y, as at a vertical edge, and odd ones the reverse."""
    instants = np.arange(80) * 40.0
    truth = parabola(instants)
    std = np.where((np.arange(80)[:, None] + np.arange(8)) % 2, 1.0, 0.1)
    left = [
        rms_px(fit("smoothing-spline", instants, noisy(truth, std, seed), information(truth, std)), truth, instants)
        for seed in range(3)
    ]
    expected = 0.1 * np.sqrt(3 / 40)
    assert 0.8 * expected < np.mean(left) < 1.5 * expected


def test_smoothing_spline_fills_direction_without_information(fit):
    instants = np.arange(40) * 40.0
    truth = parabola(instants)
    knots = noisy(truth, np.where(np.arange(40)[:, None] == 20, 300.0, 0.1))
    worth = information(truth, 0.1)
    worth[20] = 0
    assert rms_px(fit("smoothing-spline", instants, knots, worth), truth, instants) < 0.1


def test_smoothing_spline_does_not_depend_on_scale_of_information(fit):
    """The noise is estimated, since the information of locators may be wrong by a factor."""
    rng = np.random.default_rng(0)
    instants = np.cumsum(rng.uniform(20, 60, 30))
    std = rng.uniform(0.1, 1, (30, 8))
    truth = parabola(instants)
    knots = noisy(truth, std)
    frames = np.linspace(0, 1500, 50)
    once, more = (fit("smoothing-spline", instants, knots, scale * information(truth, std)).at(frames) for scale in (1, 1e4))
    np.testing.assert_allclose(more, once, rtol=1e-6, atol=1e-9)


def shaken(frames: np.ndarray, period: float) -> np.ndarray:
    """Rotation vectors of a slow sweep, with a tremor of about 2 px."""
    phases = 2 * np.pi * np.asarray(frames) / period
    sweep = np.asarray(frames) / 4000
    shake = np.stack([np.sin(phases), np.sin(0.83 * phases + 1), np.sin(1.1 * phases + 2)], axis=1) / 750
    return np.stack([0.1 * np.sin(2 * sweep), 0.2 * sweep, 0 * sweep], axis=1) + shake


@pytest.mark.parametrize("knots_per_period", [2.3, 3, 4, 8, 16])
@pytest.mark.parametrize("informed", [False, True])
def test_smoothing_spline_keeps_motion_too_fast_for_the_knots(knots_per_period, informed, fit, turning):
    instants, frames = np.arange(80) * 50.0, np.arange(0, 3951, 7.0)
    knots, truth = (turning(shaken(t, 50 * knots_per_period)) for t in (instants, frames))
    worth = information(knots, 0.05) if informed else None
    knots = noisy(knots, 0.05)
    smoothed, cubic = (
        rms_px(fit(name, instants, knots, worth), truth, frames) for name in ("smoothing-spline", "lucas-kanade")
    )
    assert smoothed < 1.1 * cubic
    if knots_per_period >= 8:
        assert smoothed < 0.9 * cubic


@pytest.mark.parametrize("n_knots", [4, 5, 7, 40])
def test_smoothing_spline_without_noise_is_the_cubic(n_knots, fit, turning):
    instants = np.arange(n_knots) * 50.0
    frames = np.linspace(0, instants[-1], 300)
    knots, truth = turning(shaken(instants, 600)), turning(shaken(frames, 600))
    smoothed, cubic = (rms_px(fit(name, instants, knots), truth, frames) for name in ("smoothing-spline", "lucas-kanade"))
    assert smoothed < 1.05 * cubic + 1e-3


@pytest.mark.parametrize("n_knots", [1, 2, 3])
def test_smoothing_spline_interpolates_three_knots_and_fewer(n_knots, fit, motions):
    instants, knots, frames = np.array([0, 30, 100.0])[:n_knots], motions(n_knots, 0), np.linspace(-50, 150, 30)
    smoothed, cubic = (fit(name, instants, knots).at(frames) for name in ("smoothing-spline", "lucas-kanade"))
    np.testing.assert_allclose(smoothed, cubic, rtol=1e-9, atol=1e-12)


def test_smoothing_spline_of_still_camera_stands_still(fit):
    trajectory = fit("smoothing-spline", np.arange(20) * 10.0, np.stack([np.eye(3)] * 20))
    np.testing.assert_allclose(trajectory.at([-5, 33.3, 500]), np.stack([np.eye(3)] * 3), atol=1e-12)


def test_smoothing_spline_accounts_for_uneven_knots(fit):
    """Knots in pairs with gaps in between, as at the ends of a level, and where exposures were lost."""
    instants = np.cumsum(np.tile([5.0, 95.0], 30))
    truth = parabola(instants)
    left = [rms_px(fit("smoothing-spline", instants, noisy(truth, 0.3, seed)), truth, instants) for seed in range(3)]
    assert np.mean(left) < 2 * 0.3 * np.sqrt(3 / 60)
