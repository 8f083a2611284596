from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano.evaluation import corner_errors
from photonpano.geometry import (
    FrameTrajectory,
    align_planes,
    apply,
    corners,
    from_parameters,
    inverse,
    normalised,
    rescaling,
    translation,
)


def jittered(motion: np.ndarray, sigma_px: float, seed: int = 1) -> np.ndarray:
    """Shift every frame by its own normal offset, in pixels of the frame."""
    offsets = np.random.default_rng(seed).normal(0, sigma_px, (len(motion), 2))
    return normalised(motion @ np.array([translation(x, y) for x, y in offsets]))


@st.composite
def gauges(draw: st.DrawFn) -> np.ndarray:
    """Draw a change of the reference plane: similarity, shear and perspective that keep the scene in front of the camera."""
    small = st.floats(-0.2, 0.2)
    perspective = st.floats(-4e-4, 4e-4)
    shift = st.floats(-500, 500)
    p = [draw(s) for s in (small, small, small, small, shift, shift, perspective, perspective)]
    return rescaling(draw(st.floats(0.2, 5))) @ from_parameters(p)


@settings(max_examples=25, deadline=None)
@given(gauge=gauges())
def test_align_planes_finds_any_change_of_plane(gauge, true_motion, frame_shape):
    found = align_planes(normalised(gauge @ true_motion), true_motion, frame_shape)
    points = apply(true_motion[::40], corners(frame_shape))
    np.testing.assert_allclose(apply(found @ gauge, points), points, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(gauge=gauges())
def test_corner_errors_do_not_depend_on_estimated_plane(gauge, true_motion, frame_shape):
    estimated = jittered(true_motion, 0.5)
    here = corner_errors(estimated, true_motion, frame_shape)
    there = corner_errors(normalised(gauge @ estimated), true_motion, frame_shape)
    np.testing.assert_allclose(there.errors_px, here.errors_px, atol=1e-4)


def test_corner_errors_do_not_depend_on_true_plane(true_motion, frame_shape):
    estimated = jittered(true_motion, 0.5)
    scene = rescaling(3.0) @ translation(20, -90)
    here = corner_errors(estimated, true_motion, frame_shape)
    there = corner_errors(estimated, normalised(scene @ true_motion), frame_shape)
    np.testing.assert_allclose(there.errors_px, here.errors_px, atol=1e-4)


def test_corner_errors_of_random_shifts_follow_rayleigh_distribution(true_motion, frame_shape):
    true = np.tile(true_motion, (20, 1, 1))
    score = corner_errors(jittered(true, 0.4), true, frame_shape)
    # The length of a normal vector in the plane follows Rayleigh's law.
    assert score.mean_px == pytest.approx(0.4 * np.sqrt(np.pi / 2), rel=0.03)
    assert score.median_px == pytest.approx(0.4 * np.sqrt(2 * np.log(2)), rel=0.04)
    assert score.p95_px == pytest.approx(0.4 * np.sqrt(-2 * np.log(0.05)), rel=0.04)
    assert score.max_px == score.errors_px.max()


def test_corner_errors_find_one_wrong_frame(true_motion, frame_shape):
    estimated = true_motion.copy()
    estimated[37] = normalised(true_motion[37] @ translation(3, 4))
    score = corner_errors(estimated, true_motion, frame_shape)
    assert int(np.argmax(score.errors_px)) == 37
    assert score.max_px == pytest.approx(5, rel=0.05)
    assert score.median_px < 0.2


def test_corner_errors_ignore_frames_that_are_not_located(true_motion, frame_shape):
    estimated = true_motion.copy()
    estimated[:30] = normalised(true_motion[:30] @ translation(40, 0))
    located = np.arange(len(true_motion)) >= 30
    score = corner_errors(estimated, true_motion, frame_shape, located)
    assert score.max_px < 1e-6
    assert score.located_share == 0.75
    np.testing.assert_allclose(score.errors_px[:30], 40, atol=1e-5)


def test_corner_errors_of_single_frame_are_0(true_motion, frame_shape):
    score = corner_errors(np.eye(3)[None], true_motion[:1], frame_shape)
    assert score.max_px < 1e-9


def test_align_planes_is_finite_with_frame_at_the_horizon(true_motion, frame_shape):
    estimated = true_motion.copy()
    estimated[5] = from_parameters([0, 0, 0, 0, 0, 0, -1 / 40, 0])  # its horizon crosses the frame
    score = corner_errors(estimated, true_motion, frame_shape)
    assert np.isfinite(score.alignment).all()
    assert int(np.argmax(score.errors_px)) == 5


def test_corner_errors_do_not_depend_on_number_of_frames(true_motion, frame_shape):
    estimated = jittered(true_motion, 0.5)
    few = corner_errors(estimated, true_motion, frame_shape)
    many = corner_errors(np.repeat(estimated, 50, axis=0), np.repeat(true_motion, 50, axis=0), frame_shape)
    assert many.mean_px == pytest.approx(few.mean_px, rel=0.02)


@pytest.mark.parametrize(("estimated", "true"), [(3, 4), (0, 0)])
def test_corner_errors_refuse_trajectories_of_different_length(estimated, true, true_motion, frame_shape):
    with pytest.raises(ValueError, match=f"{estimated} "):
        corner_errors(true_motion[:estimated], true_motion[:true], frame_shape)


def test_frame_trajectory_interpolates_linearly(true_motion):
    trajectory = FrameTrajectory(true_motion)
    np.testing.assert_array_equal(trajectory.at(np.arange(120)), true_motion)
    np.testing.assert_allclose(trajectory.at([10.25])[0], 0.75 * true_motion[10] + 0.25 * true_motion[11], rtol=1e-12)
    np.testing.assert_array_equal(trajectory.at([-3.0, 500.0]), true_motion[[0, -1]])


def test_frame_trajectory_of_one_frame_is_constant(true_motion):
    np.testing.assert_array_equal(FrameTrajectory(true_motion[:1]).at([0, 0.5, 1]), true_motion[[0, 0, 0]])


def test_align_planes_maps_estimated_plane_to_true_plane(true_motion, frame_shape):
    gauge = translation(7, -3)
    np.testing.assert_allclose(align_planes(gauge @ true_motion, true_motion, frame_shape), inverse(gauge), atol=1e-7)
