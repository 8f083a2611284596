"""A camera that only turns: its motion graph, its lens and its trajectories."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from photonpano.contracts.protocols import Interpolator
from photonpano.geometry import (
    Camera,
    align_rotations,
    corner_displacements,
    corners,
    patch_centres,
    rotation_matrices,
    rotation_vectors,
    scaled_ahead,
    transform_points,
)
from photonpano.locating import fit_homography
from photonpano.motion.frame_motion import motion_of_frames
from photonpano.motion.graph import GraphSolution, solve
from photonpano.motion.models import ModelName, MotionModel
from photonpano.motion.rotations import Rotations, RotationTrajectory, fit_rotations
from photonpano.values import Edge, FloatArray, FrameSpan, Located, NotLocated, Patches, StreamInfo
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators import GeodesicInterpolator, LucasKanadeInterpolator, SmoothingSplineInterpolator

from .measured_graphs import NOISE_PX, edge, groups_of, noise_of

SHAPE = (254, 496)
FOCAL_PX = 330.0


def turn(n_nodes: int, degrees: float) -> FloatArray:
    """Return rotations about the vertical with a wobble in pitch and roll: (N, 3, 3)."""
    angle = np.deg2rad(np.linspace(0, degrees, n_nodes))
    wobble = np.stack([0.05 * np.sin(3 * angle), np.zeros(n_nodes), 0.03 * np.cos(2 * angle)], axis=1)
    return rotation_matrices(np.outer(angle, [0, 1, 0])) @ rotation_matrices(wobble)


def edges_of(rotations: FloatArray, rng: np.random.Generator, further: float = 0.0) -> list[Edge]:
    """Return pairs of neighbours, second neighbours and what overlaps after a full turn, with the noise of their exposures.

    Args:
        rotations: of the nodes.
        rng: of the noise.
        further: how much further than a rotation each node is stretched along x, relative to its number.
    """
    stretched = np.stack([np.diag([1 + further * node, 1, 1]) for node in range(len(rotations))])
    maps = Camera.of(FOCAL_PX, SHAPE).homographies(rotations) @ stretched
    noise, ahead = noise_of(groups_of(len(rotations)), rng), rotations[:, :, 2]
    near = [(i, j) for i in range(len(rotations)) for j in range(i) if i - j <= 2 or ahead[i] @ ahead[j] > np.cos(0.3)]
    return [edge(maps, moving, fixed, noise) for moving, fixed in near]


def error_deg(solution: GraphSolution, rotations: FloatArray) -> FloatArray:
    """Return the angles between true and estimated rotations, once aligned: (N,)."""
    assert solution.rotations is not None
    found = solution.rotations.rotations
    away = np.swapaxes(rotations, -1, -2) @ align_rotations(found, rotations) @ found
    return np.rad2deg(np.linalg.norm(rotation_vectors(away), axis=1))


@pytest.mark.parametrize("degrees", [40.0, 400.0])
def test_rotations_and_focal_length_are_found_at_any_angle(degrees: float) -> None:
    rotations = turn(60, degrees)
    solution = solve(
        groups_of(60), edges_of(rotations, np.random.default_rng(0)), 30, frame_shape=SHAPE, model=MotionModel(kind="rotation")
    )
    assert solution.rotations is not None
    error_focal = solution.rotations.camera.focal_px / FOCAL_PX - 1
    std_focal = solution.assess().std_camera[0] / FOCAL_PX
    assert abs(error_focal) < 3 * std_focal < 0.03
    assert error_deg(solution, rotations).max() < np.rad2deg(3 * NOISE_PX / FOCAL_PX)


def test_expected_errors_of_rotations_hold() -> None:
    """The corner errors of many solutions are what `std_px` says, and the focal lengths scatter by `std_camera`."""
    rotations, camera = turn(20, 60.0), Camera.of(FOCAL_PX, SHAPE)
    errors, stds, focals, focal_stds = [], [], [], []
    for seed in range(12):
        solution = solve(
            groups_of(20),
            edges_of(rotations, np.random.default_rng(seed)),
            10,
            frame_shape=SHAPE,
            model=MotionModel(kind="rotation"),
        )
        assessed = solution.assess()
        assert solution.rotations is not None
        found = solution.rotations.rotations
        aligned = align_rotations(found, rotations) @ found
        away = camera.homographies(np.swapaxes(rotations, -1, -2) @ aligned)
        errors.append(np.square(transform_points(away, corners(SHAPE)) - corners(SHAPE)).sum(axis=-1).mean(axis=-1))
        stds.append(assessed.std_px**2)
        focals.append(solution.rotations.camera.focal_px / FOCAL_PX - 1)
        focal_stds.append(assessed.std_camera[0] / FOCAL_PX)
    assert 0.8 < np.sqrt(np.mean(errors) / np.mean(stds)) < 1.25
    assert np.std(focals) / np.mean(focal_stds) == pytest.approx(1, abs=0.5)


def test_auto_takes_rotations_of_a_camera_that_turns() -> None:
    solution = solve(
        groups_of(20), edges_of(turn(20, 60.0), np.random.default_rng(0)), 10, frame_shape=SHAPE, model=MotionModel(kind="auto")
    )
    assert solution.rotations is not None
    assert solution.model.kind == "rotation"
    rivals = solution.compare()
    assert rivals["rotation"].deviance == 0


def test_auto_takes_homographies_where_no_rotation_explains_the_pairs() -> None:
    """Each exposure is stretched by a thousandth more than the one before: 0.25 px at the ends of a frame."""
    edges = edges_of(turn(20, 60.0), np.random.default_rng(0), further=0.004)
    plain = solve(groups_of(20), edges, 10, frame_shape=SHAPE)
    solution = solve(groups_of(20), edges, 10, frame_shape=SHAPE, model=MotionModel(kind="auto"))
    assert solution.rotations is None
    assert solution.compare()["homography"].deviance == 0
    np.testing.assert_array_equal(solution.homographies, plain.homographies)


LENS = (-0.1, 0.0, 0.0, 0.0)


NEAR = (-0.105, 0.028, 0.0, 0.0)


def bent(rotations: FloatArray, camera: Camera, seen_by: Camera) -> list[Edge]:
    """Return pairs of neighbours, with patches, as pixels show them that were undistorted with another camera."""
    points, rng, std_px = patch_centres(SHAPE), np.random.default_rng(0), 0.05
    here, found = camera.ideal(seen_by.distorted(points)), []
    for moving in range(len(rotations)):
        for fixed in range(max(0, moving - 3), moving):
            relative = camera.homographies(rotations[fixed].T @ rotations[moving])
            there = seen_by.ideal(camera.distorted(transform_points(relative, here)))
            there += std_px * rng.normal(size=there.shape)
            fit = fit_homography(points, there, np.ones(len(points)), scaled_ahead(relative))
            shifts = there - transform_points(fit.homography, points)
            patches = Patches(shifts, np.tile(np.eye(2) / std_px**2, (len(points), 1, 1)))
            found.append(Edge(moving, fixed, Located(fit.homography, fit.information, fit.residual_px, patches=patches)))
    return found


@pytest.mark.parametrize(
    ("focal_px", "seen_by"),
    [(330.0, (333.0, *NEAR)), (2000.0, (2000.0, 0.0, 0.0, 0.0, 0.0))],
    ids=["a lens nearly known", "a weak lens"],
)
def test_patches_of_pairs_show_the_lens_that_their_homographies_follow(focal_px: float, seen_by: tuple[float, ...]) -> None:
    camera, assumed = Camera.of(focal_px, SHAPE, (-0.11, 0.03, 0, 0)), Camera.of(seen_by[0], SHAPE, seen_by[1:])
    model = MotionModel(kind="auto").knowing(assumed) if assumed.distorts else MotionModel(kind="auto")
    solution = solve(groups_of(20), bent(turn(20, 2e4 / focal_px), camera, assumed), 10, frame_shape=SHAPE, model=model)
    assert solution.model.name == "rotation with a lens"
    assert solution.rotations is not None
    found, std = solution.rotations.camera.numbers, solution.assess().std_camera
    assert np.abs((found - camera.numbers)[:3] / std[:3]).max() < 4
    assert std[0] < 0.05 * focal_px


@pytest.mark.parametrize(("k1", "rough", "finds"), [(-0.11, True, True), (-0.04, True, False), (-0.04, False, True)])
def test_lens_must_be_clear_as_long_as_a_level_of_larger_exposures_follows(k1: float, rough: bool, finds: bool) -> None:
    """With a k1 of -0.04, rotations with a lens are likelier by a deviance between 0 and 6."""
    pairs = bent(turn(20, 10.0), Camera.of(2000.0, SHAPE, (k1, 0, 0, 0)), Camera.of(2000.0, SHAPE))
    solution = solve(groups_of(20), pairs, 10, frame_shape=SHAPE, model=MotionModel(kind="auto", rough=rough))
    assert solution.model.finds_lens == finds
    assert (0 < solution.compare()["rotation"].deviance < 6) == (k1 == -0.04)


def test_auto_gives_up_a_lens_that_the_level_before_took_by_chance() -> None:
    camera, assumed = Camera.of(2000.0, SHAPE), Camera.of(2020.0, SHAPE, (0.1, 0, 0, 0))
    model = MotionModel(kind="auto").knowing(assumed)
    solution = solve(groups_of(20), bent(turn(20, 10.0), camera, assumed), 10, frame_shape=SHAPE, model=model)
    assert solution.model.name == "rotation"
    assert solution.rotations is not None
    assert not solution.rotations.camera.distorts
    assert abs(solution.rotations.camera.focal_px - 2000) < 4 * solution.assess().std_camera[0]


@pytest.mark.parametrize(
    ("given", "contradicted"),
    [((330.0, -0.1), None), ((331.0, -0.1), None), ((337.0, -0.1), 0), ((330.0, -0.08), 1), ((330.0, 0.0), 1)],
)
def test_pairs_contradict_a_focal_length_or_a_lens_that_is_wrong(given: tuple[float, float], contradicted: int | None) -> None:
    """A wrong lens does not pass for a wrong focal length, with which the best one with that lens is many px too large."""
    focal_px, k1 = given
    true, seen_by = Camera.of(330.0, SHAPE, LENS), Camera.of(focal_px, SHAPE, (k1, 0, 0, 0))
    model = MotionModel(kind="rotation", focal_px=focal_px, distortion=(k1, 0.0, 0.0, 0.0))
    solution = solve(groups_of(20), bent(turn(20, 60.0), true, seen_by), 10, frame_shape=SHAPE, model=model)
    assert solution.rotations is not None
    np.testing.assert_array_equal(solution.rotations.camera.numbers[:2], given)
    freed = solution.freed()
    assert freed is not None
    assert freed.given == given[freed.number]
    assert abs(freed.found - true.numbers[freed.number]) < 4 * freed.std
    assert (freed.number if abs(freed.found - freed.given) > 10 * freed.std else None) == contradicted


def behind_things_that_are_near(rotations: FloatArray, camera: Camera) -> list[Edge]:
    """A third of the frame shifts by 0.8 px from exposure to exposure, and homographies follow it as far as they can."""
    points, rng, edges = patch_centres(SHAPE), np.random.default_rng(0), []
    for moving in range(len(rotations)):
        for fixed in range(max(0, moving - 3), moving):
            there = transform_points(camera.homographies(rotations[fixed].T @ rotations[moving]), points)
            there[points[:, 0] < SHAPE[1] / 3, 0] += 0.8 * (moving - fixed)
            there += 0.05 * rng.normal(size=there.shape)
            fit = fit_homography(points, there, np.ones(len(points)), camera.homographies(np.eye(3)))
            patches = Patches(there - transform_points(fit.homography, points), np.tile(np.eye(2) / 0.05**2, (144, 1, 1)))
            edges.append(Edge(moving, fixed, Located(fit.homography, fit.information, 0.05, patches=patches)))
    return edges


@pytest.mark.parametrize(
    "kind",
    [
        "rotation",
        "auto",
    ],
)
def test_pairs_follow_the_background_behind_things_that_are_near(kind: ModelName) -> None:
    camera, rotations = Camera.of(430.0, SHAPE), turn(16, 30.0)
    edges = behind_things_that_are_near(rotations, camera)
    solution = solve(groups_of(16), edges, 8, frame_shape=SHAPE, model=MotionModel(kind=kind))
    true = camera.homographies(rotations[8].T @ rotations)
    away = corner_displacements(np.linalg.inv(true) @ solution.homographies, np.eye(3), SHAPE)
    assert away.mean() < 0.15
    assert solution.model.name == "rotation"
    assert solution.parallax == pytest.approx(15 * 0.8 / 430, rel=0.2)
    without = [replace(each, motion=replace(each.motion, patches=None)) for each in edges]
    pulled = solve(
        groups_of(16), without, 8, frame_shape=SHAPE, model=MotionModel(kind="rotation", focal_px=430.0)
    ).homographies
    assert corner_displacements(np.linalg.inv(true) @ pulled, np.eye(3), SHAPE).mean() > 1


CAMERA = Camera.of(330.0, SHAPE)
CONFIG = InterpolatorConfig()
INTERPOLATORS = {
    "smoothing-spline": SmoothingSplineInterpolator(CONFIG, SHAPE),
    "lucas-kanade": LucasKanadeInterpolator(CONFIG),
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


def test_smoothing_spline_lowers_the_noise_of_turns_with_information() -> None:
    """The wobble is slow: each frame is known from many knots."""
    instants, frames, std = np.linspace(10, 990, 300), np.arange(20.0, 980.0), 1e-3
    rng = np.random.default_rng(0)
    knots = rotations_at(instants, 300.0) @ rotation_matrices(rng.normal(scale=std, size=(300, 3)))
    trajectory = fitted(INTERPOLATORS["smoothing-spline"], instants, knots, std)
    true = rotations_at(frames, 300.0)
    away = rotation_vectors(np.swapaxes(true, -1, -2) @ trajectory._free_rotations(frames))
    assert away.std() < 0.5 * std


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
    for model in (MotionModel(kind="rotation", known=known), MotionModel(kind="auto", known=known)):
        found = level.turning(model.turning_camera(shape))
        np.testing.assert_allclose(found.locators[0].component.matrix, [[200, 0, 39.5], [0, 200, 31.5], [0, 0, 1]])
        assert found.locators[1] is level.locators[1]
    for unknown in (MotionModel(kind="rotation"), MotionModel(kind="homography", focal_px=400.0), MotionModel(kind="affine")):
        assert level.turning(unknown.turning_camera(shape)) is level


@pytest.mark.parametrize("kind", ["auto", "translation", "euclidean"])
def test_locators_may_shift_and_roll_the_image_where_no_model_denies_it(make_level: Callable, kind: ModelName) -> None:
    """Where little light leaves eight numbers of a pair uncertain, its shift and roll are those of a camera far away."""
    found = make_level(motion=None, locator=_Turning()).turning(MotionModel(kind=kind).turning_camera((128, 160)))
    assert found.locators[0].component.matrix[0, 0] > 1000 * 160


def test_reference_that_is_not_located_is_the_next_frame_that_is_also_of_a_camera_that_turns_away() -> None:
    """From frame 20 on, frames are located; those at the end look back, where no homography has h33 = 1."""
    camera, rotations = Camera.of(FOCAL_PX, SHAPE), turn(100, 250)
    covered = SimpleNamespace(covered=FrameSpan(20, 100))
    known = SimpleNamespace(at=lambda frames: camera.homographies(rotations[np.asarray(frames, int)]), camera=camera)
    sure = SimpleNamespace(at=lambda frames: np.zeros(len(frames)), remaining_at=lambda frames: np.zeros(len(frames)))
    level = SimpleNamespace(located=covered, exposures=SimpleNamespace(timeline=None), uncertainty=sure, trajectory=known)
    motion = motion_of_frames([level], StreamInfo(100, *SHAPE, None), 0)
    assert motion.reference == 20
    np.testing.assert_allclose(np.linalg.det(motion.homographies), 1)
    np.testing.assert_allclose(motion.rotations, rotations[20].T @ rotations, atol=1e-9)
