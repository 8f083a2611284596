from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.geometry import from_parameters, parameters, translation
from photonpano_core.configs import LucasKanadeConfig
from photonpano_core.lucas_kanade import LucasKanadeInterpolator, LucasKanadeTrajectory

SIZES = np.array([1e-2, 1e-2, 1e-2, 1e-2, 100, 100, 1e-5, 1e-5])
"""What the eight parameters come to, roughly."""


def fit(instants: np.ndarray, homographies: np.ndarray, **config: float) -> LucasKanadeTrajectory:
    interpolator = LucasKanadeInterpolator(LucasKanadeConfig(**config))
    return interpolator.fit(np.asarray(instants, float), homographies, None)


@given(
    gaps=st.lists(st.floats(1, 500), min_size=1, max_size=12),
    seed=st.integers(0, 2**32 - 1),
)
def test_it_goes_through_every_knot(gaps: list[float], seed: int) -> None:
    instants = np.cumsum(gaps)
    knots = from_parameters(np.random.default_rng(seed).normal(size=(len(gaps), 8)) * SIZES)
    trajectory = fit(instants, knots)
    np.testing.assert_allclose(trajectory.at(instants), knots, rtol=0, atol=1e-6)
    assert trajectory.located(instants).all()


@pytest.mark.parametrize(("n_knots", "degree"), [(1, 0), (2, 1), (3, 2), (4, 3), (9, 3)])
def test_it_reproduces_polynomials_as_high_as_the_knots_allow(n_knots: int, degree: int) -> None:
    coefficients = np.random.default_rng(0).normal(size=(degree + 1, 8)) * SIZES

    def motion(frames: np.ndarray) -> np.ndarray:
        t = np.asarray(frames)[:, None] / 100 - 3
        return from_parameters(sum(c * t**power for power, c in enumerate(coefficients)))

    instants = np.linspace(49.5, 849.5, n_knots)
    between = np.linspace(instants[0], instants[-1], 33)
    np.testing.assert_allclose(fit(instants, motion(instants)).at(between), motion(between), rtol=0, atol=1e-8)


def test_one_knot_is_a_still_camera() -> None:
    trajectory = fit(np.array([50.0]), translation(3, 4)[None])
    np.testing.assert_array_equal(trajectory.at([0, 50, 1000]), [translation(3, 4)] * 3)
    np.testing.assert_array_equal(trajectory.located([49.5, 50, 50.5]), [False, True, False])


def test_beyond_the_knots_the_velocity_is_held_and_then_the_camera_stands_still() -> None:
    """By default for the mean distance of the knots: 100 frames, here at half a pixel a frame."""
    instants = np.array([100.0, 200, 300])
    trajectory = fit(instants, np.stack([translation(0.5 * frame, 0) for frame in instants]))
    x = trajectory.at([300, 350, 400, 401, 5000, 100, 50, 0, -5000])[:, 0, 2]
    np.testing.assert_allclose(x, [150, 175, 200, 200, 200, 50, 25, 0, 0], atol=1e-9)


def test_the_velocity_is_that_at_the_last_knot() -> None:
    """A parabola x = t^2 / 100 moves by 2 px a frame at 100."""
    instants = np.array([0.0, 50, 100])
    trajectory = fit(instants, np.stack([translation(frame**2 / 100, 0) for frame in instants]), hold_frames=10)
    np.testing.assert_allclose(trajectory.at([105, 110, 111])[:, 0, 2], [110, 120, 120])


def test_nothing_is_held_when_the_spec_says_so() -> None:
    trajectory = fit(np.array([0.0, 100]), np.stack([np.eye(3), translation(50, 0)]), hold_frames=0)
    np.testing.assert_allclose(parameters(trajectory.at([-10, 130]))[:, 4], [0, 50])


def test_it_tells_what_lies_between_the_knots() -> None:
    trajectory = fit(np.array([10.0, 20, 30]), np.stack([np.eye(3)] * 3))
    np.testing.assert_array_equal(trajectory.located([9.9, 10, 25.5, 30, 30.1]), [False, True, True, True, False])
