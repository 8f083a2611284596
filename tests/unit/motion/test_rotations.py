"""Trajectories of a camera that turns by any angle."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import Camera, rotation_matrices, rotation_vectors
from photonpano.motion.model import MotionModel
from photonpano.motion.rotation_graph import Rotations
from photonpano.motion.rotations import RotationTrajectory, fit_rotations
from photonpano.protocols import Interpolator
from photonpano.values import FloatArray, NotLocated
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators.interpolating import GeodesicInterpolator, LieInterpolator, LucasKanadeInterpolator
from photonpano_core.interpolators.smoothing_spline import SmoothingSplineInterpolator

SHAPE = (254, 496)
CAMERA = Camera.of(330.0, SHAPE)
CONFIG = InterpolatorConfig()
INTERPOLATORS = {
    "smoothing-spline": SmoothingSplineInterpolator(CONFIG, SHAPE),
    "lucas-kanade": LucasKanadeInterpolator(CONFIG),
    "sl3": LieInterpolator(CONFIG, SHAPE),
    "geodesic": GeodesicInterpolator(CONFIG),
}


def rotations_at(instants: FloatArray, degrees: float) -> FloatArray:
    """Return a turn in 1,000 frames, with a wobble: (N, 3, 3)."""
    angle = np.deg2rad(degrees) * np.asarray(instants) / 1000
    wobble = np.stack([0.02 * np.sin(instants / 150), 0 * angle, 0.02 * np.cos(instants / 200)], axis=-1)
    return rotation_matrices(angle[:, None] * [0, 1, 0]) @ rotation_matrices(wobble)


def fitted(
    interpolator: Interpolator, instants: FloatArray, rotations: FloatArray, std_rad: float | None
) -> RotationTrajectory:
    information = None if std_rad is None else np.broadcast_to(np.eye(3) / std_rad**2, (len(instants), 3, 3))
    free = fit_rotations(interpolator, instants, Rotations(rotations, CAMERA), information, lambda found, **_: found)
    return RotationTrajectory(free, CAMERA, 500)


def errors_px(found: FloatArray, true: FloatArray) -> FloatArray:
    return np.asarray(330 * np.linalg.norm(rotation_vectors(np.swapaxes(true, -1, -2) @ found), axis=1))


@pytest.mark.parametrize("degrees", [20.0, 200.0, 720.0])
@pytest.mark.parametrize("name", INTERPOLATORS)
def test_trajectory_follows_a_turn_by_any_angle(name: str, degrees: float) -> None:
    instants, frames = np.linspace(10, 990, 60), np.arange(1000.0)
    trajectory = fitted(INTERPOLATORS[name], instants, rotations_at(instants, degrees), None)
    true = rotations_at(frames, degrees)
    errors = errors_px(trajectory.rotations(frames), true[500].T @ true)
    # Straight pieces of the geodesic cut the corners of the wobble, and a spline of p1..p8 leaves the rotations a little.
    assert errors[10:990].max() < {"geodesic": 0.1, "lucas-kanade": 0.06}.get(name, 0.03)
    assert errors.max() < 0.3


def test_homographies_have_determinant_1_and_are_the_identity_at_the_reference() -> None:
    instants = np.linspace(10, 990, 60)
    trajectory = fitted(INTERPOLATORS["smoothing-spline"], instants, rotations_at(instants, 400.0), None)
    homographies = trajectory.at(np.arange(1000))
    np.testing.assert_allclose(np.linalg.det(homographies), 1)
    np.testing.assert_allclose(homographies[500], np.eye(3), atol=1e-9)
    assert homographies[:, 2, 2].min() < 0


def test_smoothing_spline_lowers_the_noise_of_turns_with_information() -> None:
    """The wobble is slow: each frame is known from many knots."""
    instants, frames, std = np.linspace(10, 990, 300), np.arange(20.0, 980.0), 1e-3
    rng = np.random.default_rng(0)
    knots = rotations_at(instants, 300.0) @ rotation_matrices(rng.normal(scale=std, size=(300, 3)))
    trajectory = fitted(INTERPOLATORS["smoothing-spline"], instants, knots, std)
    true = rotations_at(frames, 300.0)
    away = rotation_vectors(np.swapaxes(true, -1, -2) @ trajectory._free_rotations(frames))
    assert away.std() < 0.5 * std


def test_single_knot_stands_still() -> None:
    trajectory = fitted(INTERPOLATORS["smoothing-spline"], np.array([500.0]), rotations_at(np.array([500.0]), 300.0), None)
    np.testing.assert_allclose(trajectory.rotations([0, 999]), [np.eye(3)] * 2, atol=1e-12)


class _Turning:
    """A locator that keeps the camera that it is given."""

    matrix: np.ndarray | None = None

    def describe(self, exposure: object) -> object:
        return exposure

    def register(self, moving: object, fixed: object, initial: object) -> NotLocated:
        return NotLocated("toy")

    def turning(self, camera_matrix: np.ndarray) -> _Turning:
        other = _Turning()
        other.matrix = camera_matrix
        return other


def test_locators_get_the_camera_in_px_of_exposures_once_its_focal_length_is_known(make_level: Callable) -> None:
    shape, known = (128, 160), Camera.of(400.0, (128, 160))
    level = make_level(motion=None, locator=_Turning(), fallbacks={"plain": object()}, scale=0.5)
    found = level.turning(MotionModel("rotation", known=known).turning_camera(shape))
    np.testing.assert_allclose(found.locators[0].component.matrix, [[200, 0, 39.5], [0, 200, 31.5], [0, 0, 1]])
    assert found.locators[1] is level.locators[1]
    for unknown in (MotionModel("rotation"), MotionModel("auto", known=known), MotionModel("homography", focal_px=400.0)):
        assert level.turning(unknown.turning_camera(shape)) is level
