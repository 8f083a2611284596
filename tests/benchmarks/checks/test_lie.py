"""The baseline `lie`: a smooth curve in the group of homographies, through every knot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import LocationError
from photonpano.geometry import corner_displacements, normalised, parameters, translation

FRAME_SHAPE = (254, 496)


@settings(max_examples=10, deadline=None)
@given(gaps=st.lists(st.floats(50, 200), min_size=1, max_size=9), seed=st.integers(0, 2**32 - 1))
def test_lie_passes_through_every_knot_in_any_plane_and_from_any_pixel_origin(gaps, seed, fit, motions):
    """In another reference plane G the curve is G H(t), also beyond the knots."""
    instants, (change, *listed) = np.cumsum(gaps), motions(len(gaps) + 1, seed)
    knots, frames = np.array(listed), np.linspace(instants[0] - 100, instants[-1] + 100, 50)
    trajectory = fit("lie", instants, knots)
    assert corner_displacements(trajectory.at(instants), knots, FRAME_SHAPE).max() < 1e-6
    plane, origin = (fit("lie", instants, normalised(moved)).at(frames) for moved in (change @ knots, knots @ change))
    here = trajectory.at(frames)
    assert corner_displacements(plane, normalised(change @ here), FRAME_SHAPE).max() < 1e-5
    assert corner_displacements(origin, normalised(here @ change), FRAME_SHAPE).max() < 1e-5


def test_lie_names_frames_without_real_logarithm(fit):
    knots = np.stack([np.eye(3), translation(3, 0), np.diag([-1.0, -1, 1])])
    with pytest.raises(LocationError, match=r"from frame 20 to frame 30\.5 the motion turns by half a turn or more"):
        fit("lie", [10, 20, 30.5], knots)


def path(frames: np.ndarray) -> np.ndarray:
    """Rotation vectors of a camera that pans, tilts and rolls by much."""
    t = np.asarray(frames) / 1000
    return np.stack([0.1 * np.sin(5 * t), 0.15 * np.cos(4 * t), np.sin(3 * t)], axis=1)


def test_lie_is_exact_for_an_angle_that_is_a_cubic_of_time(fit, turning):
    """A cubic spline reproduces it."""
    instants, frames = np.array([0.0, 130, 200, 430, 500, 610]), np.linspace(0, 610, 40)
    axis = np.array([-0.1, 0.3, 0.9])

    def angles(t: np.ndarray) -> np.ndarray:
        return (t / 1000 + (t / 600) ** 2 - (t / 700) ** 3)[:, None] * axis

    found = fit("lie", instants, turning(angles(instants))).at(frames)
    np.testing.assert_allclose(found, turning(angles(frames)), rtol=1e-8, atol=1e-10)


def test_lie_equals_cubic_spline_for_shifts(fit):
    rng = np.random.default_rng(0)
    instants, frames = np.cumsum(rng.uniform(30, 100, 9)), np.linspace(0, 700, 80)
    knots = np.stack([translation(x, y) for x, y in rng.normal(0, 30, (9, 2))])
    np.testing.assert_allclose(
        fit("lie", instants, knots).at(frames), fit("lucas-kanade", instants, knots).at(frames), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("n_knots", [2, 3])
def test_lie_lowers_degree_for_few_knots(n_knots, fit, motions):
    """With a parabola, the velocity in the frame changes at a constant rate: for shifts exactly so."""
    instants, knots = np.array([0.0, 50, 130])[:n_knots], motions(3, 1)[:n_knots]
    trajectory = fit("lie", instants, knots)
    np.testing.assert_allclose(trajectory.at(instants), knots, rtol=1e-6, atol=1e-9)
    if n_knots == 2:
        frames = np.linspace(-20, 80, 30)
        np.testing.assert_allclose(trajectory.at(frames), fit("geodesic", instants, knots).at(frames), rtol=1e-9, atol=1e-12)


def test_lie_velocity_and_acceleration_are_continuous_at_knots(fit, turning):
    instants = np.arange(0, 1001, 100.0)
    trajectories = {name: fit(name, instants, turning(path(instants))) for name in ("lie", "geodesic")}
    h = 0.5

    def jumps(name: str) -> tuple[float, float]:
        """Return the largest jumps of velocity and acceleration of a corner, as shares of the largest such value."""
        sides = []
        for side in (-1, 1):
            samples = instants[1:-1] + side * h * np.arange(3)[:, None]
            x = parameters(trajectories[name].at(samples.ravel())).reshape(3, -1, 8)[..., 4]
            sides.append((side * (-1.5 * x[0] + 2 * x[1] - 0.5 * x[2]) / h, (x[0] - 2 * x[1] + x[2]) / h**2))
        (v0, a0), (v1, a1) = sides
        return np.abs(v1 - v0).max() / np.abs(v0).max(), np.abs(a1 - a0).max() / np.abs(a0).max()

    velocity, acceleration = jumps("lie")
    assert velocity < 1e-3
    assert acceleration < 0.05
    assert jumps("geodesic")[0] > 0.05


def test_lie_beats_geodesic_on_smooth_motion_and_parameters_on_roll(fit, turning):
    instants, frames = np.linspace(0, 3000, 31), np.arange(0, 3001, 7.0)
    truth = turning(path(frames))
    errors = {
        name: corner_displacements(fit(name, instants, turning(path(instants))).at(frames), truth, FRAME_SHAPE).max()
        for name in ("lie", "geodesic", "lucas-kanade")
    }
    assert errors["lie"] < errors["geodesic"] / 20
    assert errors["lie"] < errors["lucas-kanade"]


def test_lie_follows_roll_of_more_than_one_turn(fit, turning):
    instants, frames = np.linspace(0, 1000, 41), np.linspace(0, 1000, 300)
    found = fit("lie", instants, turning(np.outer(instants / 1000, [0, 0, 20]))).at(frames)
    np.testing.assert_allclose(found, turning(np.outer(frames / 1000, [0, 0, 20])), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("instants", [[0, 1, 2, 60, 61, 62], [0, 500, 501, 502, 503, 1000]])
def test_lie_refuses_knots_without_smooth_curve(instants, fit, motions):
    with pytest.raises(LocationError) as caught:
        fit("lie", instants, motions(6, 2))
    assert str(caught.value) == (
        "no smooth curve of homographies was found through the located exposures: they turn too fast, or lie too unevenly in "
        "time; interpolate with geodesic, lucas-kanade or smoothing-spline"
    )
