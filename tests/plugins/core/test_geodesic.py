from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import fractional_matrix_power

from photonpano import LocationError
from photonpano.geometry import normalised, translation


def test_geodesic_is_exact_for_rotation_about_any_axis(fit, turning):
    instants, frames = np.array([0.0, 130, 200, 430]), np.linspace(-60, 500, 40)
    axis = np.array([-2e-4, 5e-4, 1e-3])
    trajectory = fit("geodesic", instants, turning(instants[:, None] * axis), hold_frames=100)
    np.testing.assert_allclose(trajectory.at(frames), turning(frames[:, None] * axis), rtol=1e-9, atol=1e-12)


def test_geodesic_is_exact_for_roll_unlike_parameters(fit, turning):
    roll = np.deg2rad([[0, 0, 0], [0, 0, 60]])
    half = turning(roll / 2)[1]
    np.testing.assert_allclose(fit("geodesic", [0, 100], turning(roll)).at(50)[0], half, rtol=1e-9, atol=1e-12)
    assert np.linalg.det(fit("lucas-kanade", [0, 100], turning(roll)).at(50)[0]) < 0.8


def test_geodesic_is_power_of_motion_between_knots(fit, motions):
    first, second = motions(2, 5)
    power = fractional_matrix_power(np.linalg.inv(first) @ second, 0.3).real
    found = fit("geodesic", [10, 110], np.stack([first, second])).at(40)[0]
    np.testing.assert_allclose(found, normalised(first @ power), rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("name", ["geodesic", "lie"])
@pytest.mark.parametrize("motion", [np.diag([-1.0, -1, 1]), np.diag([-1.0, 1, 1])], ids=["half a turn", "mirror"])
def test_fit_names_frames_without_real_logarithm(name, motion, fit):
    knots = np.stack([np.eye(3), translation(3, 0), motion])
    with pytest.raises(LocationError) as caught:
        fit(name, [10, 20, 30.5], knots)
    assert str(caught.value) == (
        "from frame 20 to frame 30.5 the motion turns by half a turn or more, or mirrors the image, so that it has no real "
        "logarithm; interpolate with lucas-kanade or smoothing-spline, which need none, or locate more exposures in between"
    )
