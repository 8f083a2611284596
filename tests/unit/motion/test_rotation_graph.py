"""The motion graph of a camera that only turns."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import (
    Camera,
    align_rotations,
    corners,
    from_parameters,
    jacobian,
    normalised,
    parameters,
    rotation_matrices,
    rotation_vectors,
    transform_points,
)
from photonpano.motion.graph import GraphSolution, solve
from photonpano.motion.model import MotionModel
from photonpano.values import Edge, FloatArray, Located

SHAPE = (254, 496)
FOCAL_PX = 330.0
NOISE_PX = 0.1


def turn(n_nodes: int, degrees: float) -> FloatArray:
    """Return rotations about the vertical with a wobble in pitch and roll: (N, 3, 3)."""
    angle = np.deg2rad(np.linspace(0, degrees, n_nodes))
    wobble = np.stack([0.05 * np.sin(3 * angle), np.zeros(n_nodes), 0.03 * np.cos(2 * angle)], axis=1)
    return rotation_matrices(np.outer(angle, [0, 1, 0])) @ rotation_matrices(wobble)


def edges_of(rotations: FloatArray, rng: np.random.Generator, further: float = 0.0) -> list[Edge]:
    """Return pairs of neighbours, second neighbours and what overlaps after a full turn, measured with noise at the corners.

    Args:
        rotations: of the nodes.
        rng: of the noise.
        further: how much further than a rotation each node is stretched along x, relative to its number.
    """
    camera, frame = Camera.of(FOCAL_PX, SHAPE), corners(SHAPE)
    stretched = np.stack([np.diag([1 + further * node, 1, 1]) for node in range(len(rotations))])
    maps = camera.homographies(rotations) @ stretched
    ahead = rotations[:, :, 2]
    near = [(i, j) for i in range(len(rotations)) for j in range(i) if i - j <= 2 or ahead[i] @ ahead[j] > np.cos(0.3)]
    found = []
    for moving, fixed in near:
        exact = normalised(np.linalg.inv(maps[fixed]) @ maps[moving])
        to_corners = jacobian(exact, frame).reshape(8, 8)
        noise = np.linalg.solve(to_corners, rng.normal(scale=NOISE_PX, size=8))
        homography = from_parameters(parameters(exact) + noise)
        found.append(Edge(moving, fixed, Located(homography, to_corners.T @ to_corners / NOISE_PX**2)))
    return found


def error_deg(solution: GraphSolution, rotations: FloatArray) -> FloatArray:
    """Return the angles between true and estimated rotations, once aligned: (N,)."""
    assert solution.rotations is not None
    found = solution.rotations.rotations
    away = np.swapaxes(rotations, -1, -2) @ align_rotations(found, rotations) @ found
    return np.rad2deg(np.linalg.norm(rotation_vectors(away), axis=1))


@pytest.mark.parametrize("degrees", [40.0, 400.0])
def test_rotations_and_focal_length_are_found_at_any_angle(degrees: float) -> None:
    rotations = turn(60, degrees)
    solution = solve(60, edges_of(rotations, np.random.default_rng(0)), 30, SHAPE, model=MotionModel("rotation"))
    assert solution.rotations is not None
    error_focal = solution.rotations.camera.focal_px / FOCAL_PX - 1
    std_focal = solution.assess().std_camera[0] / FOCAL_PX
    assert abs(error_focal) < 3 * std_focal < 0.03
    assert error_deg(solution, rotations).max() < np.rad2deg(3 * NOISE_PX / FOCAL_PX)


def test_expected_errors_of_rotations_hold() -> None:
    """The corner errors of many solutions are what `std_px` says, and the focal lengths scatter by `std_shared`."""
    rotations, camera = turn(20, 60.0), Camera.of(FOCAL_PX, SHAPE)
    errors, stds, focals, focal_stds = [], [], [], []
    for seed in range(12):
        solution = solve(20, edges_of(rotations, np.random.default_rng(seed)), 10, SHAPE, model=MotionModel("rotation"))
        assessed = solution.assess()
        assert solution.rotations is not None
        found = solution.rotations.rotations
        aligned = align_rotations(found, rotations) @ found
        away = camera.homographies(np.swapaxes(rotations, -1, -2) @ aligned)
        errors.append(np.square(transform_points(away, corners(SHAPE)) - corners(SHAPE)).sum(axis=-1).mean(axis=-1))
        stds.append(assessed.std_px**2)
        focals.append(solution.rotations.camera.focal_px / FOCAL_PX - 1)
        focal_stds.append(assessed.std_camera[0] / FOCAL_PX)
    assert np.mean(errors) / np.mean(stds) == pytest.approx(1, abs=0.6)
    assert np.std(focals) / np.mean(focal_stds) == pytest.approx(1, abs=0.5)


def test_known_focal_length_is_kept() -> None:
    rotations = turn(20, 60.0)
    edges = edges_of(rotations, np.random.default_rng(0))
    solution = solve(20, edges, 10, SHAPE, model=MotionModel("rotation", focal_px=FOCAL_PX))
    assert solution.rotations is not None
    assert solution.rotations.camera.focal_px == FOCAL_PX
    np.testing.assert_array_equal(solution.assess().std_camera, np.zeros(5))


def test_auto_takes_rotations_of_a_camera_that_turns() -> None:
    solution = solve(20, edges_of(turn(20, 60.0), np.random.default_rng(0)), 10, SHAPE, model=MotionModel("auto"))
    assert solution.rotations is not None
    evidence = solution.compare()
    assert evidence is not None
    assert evidence.gain == pytest.approx(1, abs=0.5)


def test_auto_takes_homographies_where_no_rotation_explains_the_pairs() -> None:
    """Each exposure is stretched by a thousandth more than the one before: 0.25 px at the ends of a frame."""
    edges = edges_of(turn(20, 60.0), np.random.default_rng(0), further=0.004)
    plain = solve(20, edges, 10, SHAPE)
    solution = solve(20, edges, 10, SHAPE, model=MotionModel("auto"))
    assert solution.rotations is None
    evidence = solution.compare()
    assert evidence is not None
    assert evidence.gain > 20
    np.testing.assert_array_equal(solution.homographies, plain.homographies)
