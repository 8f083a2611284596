"""A level that corrects a motion known at every frame: the motion keeps its tremor."""

import numpy as np

from photonpano.geometry import (
    Camera,
    FrameTrajectory,
    corner_displacements,
    from_parameters,
    inverse,
    normalised,
    parameters,
    rotation_matrices,
)
from photonpano.motion.rotations import Rotations, RotationTrajectory
from photonpano.motion.trajectories import Knots, RefinedMotion
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


def knots_of(homographies: FloatArray, camera: Camera | None = None, information: FloatArray | None = None) -> Knots:
    rotations = None if camera is None else Rotations(camera.rotations(homographies), camera)
    return Knots(INSTANTS, homographies, information, rotations)


def apart_px(first: FloatArray, second: FloatArray) -> float:
    """Return the largest difference at a corner of two motions, from their middle on."""
    middle = len(first) // 2
    return float(corner_displacements(*(inverse(each[middle]) @ each for each in (first, second)), SHAPE).max())


def test_corrections_of_a_turn_leave_out_its_tremor_and_bring_the_refined_motion_to_the_true_one() -> None:
    true = turned(2.5)
    known = CAMERA.homographies(true @ np.swapaxes(DRIFT, -1, -2))
    motion = RefinedMotion(RotationTrajectory(FrameTrajectory(known), CAMERA, 100), FRAMES, CAMERA, SHAPE)
    knots = motion.corrections(knots_of(CAMERA.homographies(true[INSTANTS]), CAMERA))
    assert knots.rotations is not None
    np.testing.assert_allclose(normalised(CAMERA.homographies(knots.rotations.rotations)), knots.homographies, atol=1e-6)
    assert apart_px(knots.homographies, CAMERA.homographies(DRIFT[INSTANTS])) < 0.03
    corrected = motion.corrected(FrameTrajectory(CAMERA.homographies(DRIFT))).at(ALL)
    assert apart_px(corrected, CAMERA.homographies(true)) < 1e-6


def test_known_homographies_become_turns_of_a_camera_that_move_the_corners_alike() -> None:
    true = turned(0.5)
    known = normalised(CAMERA.homographies(true))
    seen = RefinedMotion(FrameTrajectory(known), FRAMES, CAMERA, SHAPE).corrected(FrameTrajectory(np.eye(3)[None])).at(ALL)
    assert apart_px(seen, known) < 1e-6
    np.testing.assert_allclose(np.linalg.det(seen), 1)


def test_information_is_carried_from_the_homographies_to_their_corrections() -> None:
    """A small change of each homography is as many standard deviations as that of its correction."""
    rng = np.random.default_rng(0)
    scales = np.array([1e-2, 1e-2, 1e-2, 1e-2, 1, 1, 1e-4, 1e-4])
    true = from_parameters(rng.normal(size=(FRAMES, 8)) * scales)
    known = RefinedMotion(
        FrameTrajectory(true @ from_parameters(0.1 * rng.normal(size=(FRAMES, 8)) * scales)), FRAMES, None, SHAPE
    )
    roots = rng.normal(size=(len(INSTANTS), 8, 8)) / scales
    information = np.swapaxes(roots, -1, -2) @ roots
    knots = known.corrections(knots_of(true[INSTANTS], information=information))
    assert knots.rotations is None
    assert knots.information is not None

    change = 1e-5 * rng.normal(size=(len(INSTANTS), 8)) * scales
    change[len(INSTANTS) // 2] = 0  # to which all corrections refer
    moved = known.corrections(
        knots_of(from_parameters(parameters(true[INSTANTS]) + change), information=information)
    ).homographies
    away = parameters(moved) - parameters(knots.homographies)
    squares = [np.einsum("ni,nij,nj->n", each, of, each) for each, of in ((change, information), (away, knots.information))]
    np.testing.assert_allclose(squares[1], squares[0], rtol=1e-2, atol=1e-15)
