"""Derivatives of homographies, compared with finite differences."""

import numpy as np
import pytest

from photonpano.geometry import corners, from_parameters, generators, slopes, transform_points, unit_coordinates

SHAPE = (254, 496)
HOMOGRAPHY = np.array([[1.02, 0.03, 11.0], [-0.02, 0.98, -4.0], [2e-5, -3e-5, 1.0]])


def test_unit_coordinates_span_the_longer_side():
    edges = np.array([[-0.5, 126.5], [495.5, 126.5], [247.5, 126.5]])
    assert transform_points(unit_coordinates(SHAPE), edges) == pytest.approx(np.array([[-1, 0], [1, 0], [0, 0]]))


def test_generators_are_derivatives_of_pixel_homographies():
    unit = unit_coordinates(SHAPE)
    step = 1e-6 * np.arange(1, 9)
    changed = np.linalg.inv(unit) @ from_parameters(step) @ unit
    assert np.eye(3) + np.tensordot(step, generators(SHAPE), 1) == pytest.approx(changed, rel=1e-12, abs=1e-12)


def test_slopes_agree_with_finite_differences():
    points = corners(SHAPE)
    rows = np.concatenate([points, np.ones((4, 1))], axis=1).T
    found = slopes(HOMOGRAPHY @ rows, HOMOGRAPHY @ generators(SHAPE) @ rows)
    for parameter in range(8):
        step = np.zeros(8)
        step[parameter] = 1e-6
        moved = (np.eye(3) + sign * np.tensordot(step, generators(SHAPE), 1) for sign in (1, -1))
        ahead, behind = (transform_points(HOMOGRAPHY @ each, points) for each in moved)
        assert found[:, parameter] == pytest.approx(((ahead - behind) / 2e-6).ravel(), rel=1e-6, abs=1e-4)


def test_slopes_of_stack_equal_slopes_of_each():
    rows = np.concatenate([corners(SHAPE), np.ones((4, 1))], axis=1).T
    both = np.stack([HOMOGRAPHY, np.eye(3)])
    found = slopes(both @ rows, both[:, None] @ generators(SHAPE) @ rows)
    assert found.shape == (2, 8, 8)
    for homography, of_it in zip(both, found, strict=True):
        assert of_it == pytest.approx(slopes(homography @ rows, homography @ generators(SHAPE) @ rows))
