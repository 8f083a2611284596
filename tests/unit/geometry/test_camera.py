"""Cameras and rotations."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import Camera, nearest_rotations, rotation_matrices, rotation_vectors

LENS = (-0.1, 0.02, 1e-3, -2e-3)


def test_distorted_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    camera = Camera.of(300.0, (254, 496), LENS)
    points = np.random.default_rng(0).uniform((0, 0), (495, 253), (50, 2))
    rays = np.c_[(points - camera.centre_px) / 300.0, np.ones(50)]
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(LENS))[0][:, 0]
    np.testing.assert_allclose(camera.distorted(points), expected, atol=1e-9)


def test_ideal_inverts_distorted() -> None:
    camera = Camera.of(300.0, (254, 496), LENS)
    points = np.random.default_rng(0).uniform((0, 0), (495, 253), (2, 50, 2))
    np.testing.assert_allclose(camera.ideal(camera.distorted(points)), points, atol=1e-9)


def test_ideal_is_nan_where_the_lens_images_nothing() -> None:
    # x (1 - 0.5 x^2) is at most 0.54 focal lengths.
    camera = Camera.of(100.0, (101, 101), (-0.5, 0, 0, 0))
    assert np.isnan(camera.ideal([[50 + 60.0, 50.0]])).all()


def test_directions_of_principal_point_look_ahead() -> None:
    np.testing.assert_allclose(Camera.of(300.0, (254, 496), LENS).directions([247.5, 126.5]), [0, 0, 1], atol=1e-12)


def test_homographies_of_rotations_have_determinant_1_at_any_angle() -> None:
    camera = Camera.of(330.0, (254, 496))
    rotations = rotation_matrices([[0, 0.5, 0], [0, np.pi / 2, 0], [0.1, 3.0, 0]])
    homographies = camera.homographies(rotations)
    np.testing.assert_allclose(np.linalg.det(homographies), 1)
    np.testing.assert_allclose(camera.rotations(-2 * homographies), rotations, atol=1e-12)


def test_scaled_camera_sees_the_same_directions() -> None:
    camera, point = Camera.of(300.0, (254, 496), LENS), np.array([13.0, 40.0])
    np.testing.assert_allclose(camera.scaled(0.5).directions((point + 0.5) * 0.5 - 0.5), camera.directions(point), atol=1e-12)


def test_rotation_vectors_invert_rotation_matrices() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose(rotation_vectors(rotation_matrices(vectors)), vectors, atol=1e-12)


def test_nearest_rotations_ignores_scale_and_small_errors() -> None:
    rotations = rotation_matrices(np.random.default_rng(0).normal(size=(5, 3)))
    np.testing.assert_allclose(nearest_rotations(3 * rotations), rotations, atol=1e-12)
