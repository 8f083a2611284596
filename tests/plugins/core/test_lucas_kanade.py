from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import from_parameters, translation

SIZES = np.array([1e-2, 1e-2, 1e-2, 1e-2, 100, 100, 1e-5, 1e-5])
"""Typical sizes of the eight parameters."""


@pytest.mark.parametrize(("n_knots", "degree"), [(1, 0), (2, 1), (3, 2), (4, 3), (9, 3)])
def test_lucas_kanade_reproduces_polynomials_up_to_degree_of_knots(n_knots, degree, fit):
    coefficients = np.random.default_rng(0).normal(size=(degree + 1, 8)) * SIZES

    def motion(frames: np.ndarray) -> np.ndarray:
        t = np.asarray(frames)[:, None] / 100 - 3
        return from_parameters(sum(c * t**power for power, c in enumerate(coefficients)))

    instants = np.linspace(49.5, 849.5, n_knots)
    between = np.linspace(instants[0], instants[-1], 33)
    found = fit("lucas-kanade", instants, motion(instants)).at(between)
    np.testing.assert_allclose(found, motion(between), rtol=0, atol=1e-8)


def test_lucas_kanade_extrapolates_velocity_at_last_knot(fit):
    """A parabola x = t^2 / 100 moves by 2 px per frame at t = 100."""
    instants = np.array([0.0, 50, 100])
    trajectory = fit("lucas-kanade", instants, np.stack([translation(frame**2 / 100, 0) for frame in instants]), hold_frames=10)
    np.testing.assert_allclose(trajectory.at([105, 110, 111])[:, 0, 2], [110, 120, 120])
