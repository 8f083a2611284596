from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import Camera, corners, jacobian, parameters, rotation_matrices, scaled_ahead
from photonpano.locating import information_on_turn, turn_slopes

SHAPE = (160, 240)
CAMERA = Camera.of(300.0, SHAPE)
TURN = rotation_matrices([0.05, -0.2, 0.1])


def turned(vector: np.ndarray) -> np.ndarray:
    """Return the homography of `TURN`, after a small rotation."""
    return scaled_ahead(CAMERA.homographies(TURN @ rotation_matrices(vector)))


def test_turn_slopes_are_derivatives_of_parameters() -> None:
    step = 1e-6
    expected = [(parameters(turned(step * axis)) - parameters(turned(-step * axis))) / (2 * step) for axis in np.eye(3)]
    np.testing.assert_allclose(turn_slopes(turned(np.zeros(3)), CAMERA.matrix), np.transpose(expected), rtol=1e-6, atol=1e-9)


def test_information_on_turn_is_that_of_the_likeliest_turn() -> None:
    # Estimates of all eight parameters scatter with the inverse of the information; the turn that fits each best scatters as
    # the restricted information says.
    rng = np.random.default_rng(0)
    true = turned(np.zeros(3))
    to_corners = jacobian(true, corners(SHAPE)).reshape(8, 8)
    root = rng.normal(size=(8, 8)) @ to_corners
    information, slopes = root.T @ root, turn_slopes(true, CAMERA.matrix)
    found, std_px = information_on_turn(information, true, CAMERA.matrix, SHAPE)
    errors = np.linalg.solve(root, rng.normal(size=(8, 4000)))
    vectors = np.linalg.solve(slopes.T @ information @ slopes, slopes.T @ information @ errors)
    moved = to_corners @ slopes @ vectors
    assert std_px == pytest.approx(np.sqrt((moved**2).sum(axis=0).mean() / 4), rel=0.03)
    # Whitened by the restricted information, the three numbers of the turn have variance 1, and nothing else is known.
    along = np.einsum("in,ij,jn->n", slopes @ vectors, found, slopes @ vectors)
    assert along.mean() == pytest.approx(3, rel=0.05)
    assert np.linalg.matrix_rank(found, tol=1e-3 * np.linalg.norm(information, 2), hermitian=True) <= 3
    stds = np.sqrt(np.linalg.eigvalsh(to_corners @ np.linalg.inv(found) @ to_corners.T))
    assert (stds[-5:] > 0.9 * max(SHAPE)).all()


def test_nothing_is_known_of_a_turn_without_information() -> None:
    with pytest.raises(np.linalg.LinAlgError):
        information_on_turn(np.zeros((8, 8)), turned(np.zeros(3)), CAMERA.matrix, SHAPE)
