"""Curves of homographies: properties that interpolators share, those through every knot, and those that smooth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import LocationError, Trajectory
from photonpano.geometry import corner_displacements, corners, from_parameters, jacobian, normalised, parameters, translation

FRAME_SHAPE = (254, 496)
EXACT = ("lucas-kanade", "geodesic")
ALL = (*EXACT, "smoothing-spline")

gaps = st.lists(st.floats(50, 200), min_size=1, max_size=9)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=10, deadline=None)


@pytest.mark.parametrize("name", EXACT)
@few
@given(gaps=gaps, seed=seeds)
def test_interpolators_pass_through_every_knot(name, gaps, seed, fit, motions):
    instants, knots = np.cumsum(gaps), motions(len(gaps), seed)
    trajectory = fit(name, instants, knots)
    assert corner_displacements(trajectory.at(instants), knots, FRAME_SHAPE).max() < 1e-6


@few
@given(gaps=gaps, seed=seeds)
def test_geodesic_does_not_depend_on_reference_plane(gaps, seed, fit, motions):
    """In another reference plane G the curve is G H(t), also beyond the knots."""
    instants, (plane, *knots) = np.cumsum(gaps), motions(len(gaps) + 1, seed)
    frames = np.linspace(instants[0] - 100, instants[-1] + 100, 50)
    here = fit("geodesic", instants, np.array(knots)).at(frames)
    there = fit("geodesic", instants, normalised(plane @ knots)).at(frames)
    assert corner_displacements(there, normalised(plane @ here), FRAME_SHAPE).max() < 1e-5


@few
@given(gaps=gaps, seed=seeds)
def test_geodesic_does_not_depend_on_pixel_origin(gaps, seed, fit, motions):
    instants, (change, *knots) = np.cumsum(gaps), motions(len(gaps) + 1, seed)
    frames = np.linspace(instants[0] - 100, instants[-1] + 100, 50)
    here = fit("geodesic", instants, np.array(knots)).at(frames)
    there = fit("geodesic", instants, normalised(knots @ change)).at(frames)
    assert corner_displacements(there, normalised(here @ change), FRAME_SHAPE).max() < 1e-5


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("n_knots", [2, 3, 4, 5, 12])
def test_extrapolation_holds_velocity_then_stops(name, n_knots, fit):
    """By default for twice the mean distance of the knots: 200 frames, here at 0.5 px per frame."""
    instants = 100.0 * np.arange(1, n_knots + 1)
    trajectory = fit(name, instants, np.stack([translation(0.5 * frame, 0) for frame in instants]))
    end = instants[-1]
    frames = np.array([-5000, -100, 50, 100, 133, end, end + 50, end + 200, end + 201, 5000])
    expected = 0.5 * np.clip(frames, -100, end + 200)
    moved = trajectory.at(frames)
    np.testing.assert_allclose(moved, [translation(x, 0) for x in expected], rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ALL)
def test_extrapolation_continues_velocity_at_the_ends(name, fit, turning):
    instants = np.arange(0, 1001, 100.0)
    vectors = np.stack([1e-4 * instants, (instants / 1000) ** 2 / 10, 0 * instants], axis=1)
    trajectory = fit(name, instants, turning(vectors), hold_frames=1)
    for end, sign in ((0, -1), (1000, 1)):
        before, here, after = trajectory.at([end - sign * 0.01, end, end + sign * 0.01])
        moved = corner_displacements(np.stack([before, after]), here, FRAME_SHAPE)
        np.testing.assert_allclose(moved[1], moved[0], rtol=1e-3)


@pytest.mark.parametrize(("n_knots", "degree"), [(1, 0), (2, 1), (3, 2), (4, 3), (9, 3)])
def test_lucas_kanade_reproduces_polynomials_up_to_degree_of_knots(n_knots, degree, fit):
    coefficients = np.random.default_rng(0).normal(size=(degree + 1, 8)) * [1e-2, 1e-2, 1e-2, 1e-2, 100, 100, 1e-5, 1e-5]

    def motion(frames: np.ndarray) -> np.ndarray:
        t = np.asarray(frames)[:, None] / 100 - 3
        return from_parameters(sum(c * t**power for power, c in enumerate(coefficients)))

    instants = np.linspace(49.5, 849.5, n_knots)
    between = np.linspace(instants[0], instants[-1], 33)
    found = fit("lucas-kanade", instants, motion(instants)).at(between)
    np.testing.assert_allclose(found, motion(between), rtol=0, atol=1e-8)


def test_geodesic_is_exact_for_roll_unlike_parameters(fit, turning):
    roll = np.deg2rad([[0, 0, 0], [0, 0, 60]])
    half = turning(roll / 2)[1]
    np.testing.assert_allclose(fit("geodesic", [0, 100], turning(roll)).at(50)[0], half, rtol=1e-9, atol=1e-12)
    assert np.linalg.det(fit("lucas-kanade", [0, 100], turning(roll)).at(50)[0]) < 0.8


@pytest.mark.parametrize("motion", [np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, 1])], ids=["half a turn", "mirror"])
def test_geodesic_names_frames_without_real_logarithm(motion, fit):
    knots = np.stack([np.eye(3), translation(3, 0), motion])
    with pytest.raises(LocationError) as caught:
        fit("geodesic", [10, 20, 30.5], knots)
    assert str(caught.value) == (
        "from frame 20 to frame 30.5 the motion turns by half a turn or more, or mirrors the image, so that it has no real "
        "logarithm; interpolate with lucas-kanade or smoothing-spline, which need none, or locate more exposures in between"
    )


def test_geodesic_is_exact_for_rotation_about_any_axis(fit, turning):
    """At constant velocity."""
    instants, frames = np.array([0.0, 130, 200, 430]), np.linspace(-60, 500, 40)
    axis = np.array([-2e-4, 5e-4, 1e-3])
    trajectory = fit("geodesic", instants, turning(instants[:, None] * axis), hold_frames=100)
    np.testing.assert_allclose(trajectory.at(frames), turning(frames[:, None] * axis), rtol=1e-9, atol=1e-12)


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


def test_smoothing_spline_smooths_the_more_the_less_information_it_is_given(fit):
    """The scale of the information is trusted: noise that is known so well is no noise."""
    rng = np.random.default_rng(0)
    instants = np.cumsum(rng.uniform(20, 60, 30))
    std = rng.uniform(0.1, 1, (30, 8))
    truth = parabola(instants)
    knots = noisy(truth, std)
    errors = [
        corner_displacements(
            fit("smoothing-spline", instants, knots, scale * information(truth, std)).at(instants), truth, FRAME_SHAPE
        ).mean()
        for scale in (1, 1e4)
    ]
    unsmoothed = corner_displacements(knots, truth, FRAME_SHAPE).mean()
    assert errors[0] < 0.6 * unsmoothed
    assert errors[1] == pytest.approx(unsmoothed, rel=0.1)


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
