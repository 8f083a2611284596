"""A level that corrects a motion known at every frame: the motion keeps its tremor."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from photonpano.geometry import (
    Camera,
    FrameTrajectory,
    corner_displacements,
    inverse,
    normalised,
    rotation_matrices,
)
from photonpano.motion.refined_motion import RefinedMotion
from photonpano.motion.rotation_graph import Rotations
from photonpano.motion.rotations import RotationTrajectory
from photonpano.values import FloatArray

SHAPE, FRAMES = (40, 64), 200
CAMERA = Camera.of(100.0, SHAPE)
ALL, INSTANTS = np.arange(FRAMES), np.arange(6, 195, 17)
TREMOR = 0.01 * np.sin(ALL / 2)[:, None] * [1.0, 0.5, 0.0]


def turned(radians: float) -> FloatArray:
    """Return rotations about three axes with a tremor: (T, 3, 3)."""
    return rotation_matrices(np.stack([np.sin(ALL / 60) / 50, ALL / FRAMES * radians, np.cos(ALL / 80) / 20], axis=-1) + TREMOR)


DRIFT = rotation_matrices(
    0.01 * np.sin((ALL - INSTANTS[len(INSTANTS) // 2]) / 70)[:, None] * [1.0, -1.0, 0.5]
)  # by which what is known is off


def located(homographies: FloatArray, camera: Camera | None = None, information: FloatArray | None = None) -> Any:
    rotations = None if camera is None else Rotations(camera.rotations(homographies), camera)
    return SimpleNamespace(
        instants=INSTANTS, homographies=homographies, information=information, solution=SimpleNamespace(rotations=rotations)
    )


def apart_px(first: FloatArray, second: FloatArray) -> float:
    """Return the largest difference at a corner of two motions, from their middle on."""
    middle = len(first) // 2
    return float(corner_displacements(*(inverse(each[middle]) @ each for each in (first, second)), SHAPE).max())


def test_known_turn_of_a_camera_of_another_focal_length_moves_the_image_alike() -> None:
    known, other = Camera.of(800.0, SHAPE), Camera.of(740.0, SHAPE)
    true = known.homographies(turned(0.1))
    motion = RefinedMotion(RotationTrajectory(FrameTrajectory(true), known, 100), FRAMES, other, SHAPE)
    seen = motion.corrected(FrameTrajectory(np.eye(3)[None])).at(ALL)
    assert apart_px(seen, true) < 0.1 * apart_px(other.homographies(turned(0.1)), true)


def test_known_homographies_become_turns_of_a_camera_that_move_the_corners_alike() -> None:
    true = turned(0.5)
    known = normalised(CAMERA.homographies(true))
    seen = RefinedMotion(FrameTrajectory(known), FRAMES, CAMERA, SHAPE).corrected(FrameTrajectory(np.eye(3)[None])).at(ALL)
    assert apart_px(seen, known) < 1e-6
    np.testing.assert_allclose(np.linalg.det(seen), 1)
