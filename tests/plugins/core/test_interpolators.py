"""Properties that all interpolators share."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano.geometry import corner_displacements, normalised, translation

FRAME_SHAPE = (254, 496)
EXACT = ("lucas-kanade", "geodesic", "lie")
GROUP = ("geodesic", "lie")
ALL = (*EXACT, "smoothing-spline")

gaps = st.lists(st.floats(50, 200), min_size=1, max_size=9)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=20, deadline=None)


@pytest.mark.parametrize("name", EXACT)
@few
@given(gaps=gaps, seed=seeds)
def test_interpolators_pass_through_every_knot(name, gaps, seed, fit, motions):
    instants, knots = np.cumsum(gaps), motions(len(gaps), seed)
    trajectory = fit(name, instants, knots)
    assert corner_displacements(trajectory.at(instants), knots, FRAME_SHAPE).max() < 1e-6


@pytest.mark.parametrize("name", GROUP)
@few
@given(gaps=gaps, seed=seeds)
def test_group_interpolators_do_not_depend_on_reference_plane(name, gaps, seed, fit, motions):
    """In another reference plane G the curve is G H(t), also beyond the knots."""
    instants, (plane, *knots) = np.cumsum(gaps), motions(len(gaps) + 1, seed)
    frames = np.linspace(instants[0] - 100, instants[-1] + 100, 50)
    here = fit(name, instants, np.array(knots)).at(frames)
    there = fit(name, instants, normalised(plane @ knots)).at(frames)
    assert corner_displacements(there, normalised(plane @ here), FRAME_SHAPE).max() < 1e-5


@pytest.mark.parametrize("name", GROUP)
@few
@given(gaps=gaps, seed=seeds)
def test_interpolators_do_not_depend_on_pixel_origin(name, gaps, seed, fit, motions):
    instants, (change, *knots) = np.cumsum(gaps), motions(len(gaps) + 1, seed)
    frames = np.linspace(instants[0] - 100, instants[-1] + 100, 50)
    here = fit(name, instants, np.array(knots)).at(frames)
    there = fit(name, instants, normalised(knots @ change)).at(frames)
    assert corner_displacements(there, normalised(here @ change), FRAME_SHAPE).max() < 1e-5


@pytest.mark.parametrize("name", ALL)
def test_interpolators_return_still_camera_for_one_knot(name, fit):
    trajectory = fit(name, [50], translation(3, 4)[None])
    np.testing.assert_allclose(trajectory.at([0, 50, 1000]), [translation(3, 4)] * 3, atol=1e-12)


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


@pytest.mark.parametrize("name", ALL)
def test_extrapolation_stops_at_once_for_hold_frames_0(name, fit):
    trajectory = fit(name, [0, 100], np.stack([np.eye(3), translation(50, 0)]), hold_frames=0)
    np.testing.assert_allclose(trajectory.at([-10, 130])[:, 0, 2], [0, 50], atol=1e-12)


@pytest.mark.parametrize("name", ALL)
def test_at_returns_normalised_homographies_independent_of_other_instants(name, fit, motions):
    instants = np.arange(8) * 70.0
    trajectory = fit(name, instants, motions(8, 0))
    frames = np.linspace(-200, 700, 57)
    together = trajectory.at(frames)
    assert np.all(together[:, 2, 2] == 1)
    np.testing.assert_array_equal(together, np.concatenate([trajectory.at(frame) for frame in frames]))
