"""The world in which poses are written."""

import numpy as np
import pytest

from photonpano.geometry import rotation_matrices
from photonpano_poses import PoseEstimate, ScenePoints
from photonpano_poses.files import in_standard_world


def test_standard_world_keeps_what_the_cameras_see() -> None:
    """The first located camera is the origin and looks along z; every camera sees the points as before, but for the scale."""
    rng = np.random.default_rng(0)
    rotations, shifts, points = rotation_matrices(rng.normal(size=(5, 3))), rng.normal(size=(5, 3, 1)), rng.normal(size=(20, 3))
    poses = np.concatenate([rotations, shifts], axis=-1)
    poses[0] = np.nan
    located = np.array([False, True, True, True, True])
    known = ScenePoints(points, np.ones(20, np.float32))
    ones = np.ones(5)
    moved = in_standard_world(PoseEstimate(np.eye(3), np.zeros(4), 0.0, poses, located, ones, ones, known))
    assert moved.camera_from_world[1] == pytest.approx(np.eye(3, 4))
    seen, before = (
        np.einsum("tij,nj->tni", each[1:, :, :3], places) + each[1:, None, :, 3]
        for each, places in ((moved.camera_from_world, moved.points.positions), (poses, points))
    )
    scale = moved.std_position[1]
    np.testing.assert_allclose(seen, scale * before)
    positions = -np.einsum("tji,tj->ti", moved.camera_from_world[1:, :, :3], moved.camera_from_world[1:, :, 3])
    assert np.linalg.norm(np.diff(positions, axis=0), axis=-1).sum() == pytest.approx(1)
