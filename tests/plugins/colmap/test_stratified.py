"""Poses through the depth of the scene: each step against known truth."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Reason, StageContext
from photonpano.execution.context import Quiet
from photonpano.geometry import Camera, positions_of, rotation_matrices
from photonpano_poses import (
    CameraGuess,
    DepthMap,
    PosedView,
    PoseEstimate,
    ScenePoints,
    between,
    imaged,
    lens_of,
    pose_errors,
)
from photonpano_poses.testing import FOCAL_PX, N_POSES, POSES_SHAPE, capture, true_poses

pytest.importorskip("pycolmap")
pytest.importorskip("gtsam")

from photonpano_colmap.exposures import (
    Path,
    merge_through_depth,
    moves,
    posed,
    projected,
)
from photonpano_colmap.hooks import StratifiedPoseConfig
from photonpano_colmap.locating import Observations, adjust
from photonpano_colmap.reconstruction import FreeFocal
from photonpano_colmap.stratified import (
    Merged,
    Scene,
    StratifiedEstimator,
    interpolate,
    is_far_off,
    locate,
    merge,
    resample,
)

CAMERA = Camera.of(FOCAL_PX, POSES_SHAPE)
MATRIX = CAMERA.matrix
LENS = (-0.2, 0.0, 0.0, 0.0)
LENS_CAMERA = Camera(MATRIX, np.array(LENS))
TRUE = Path(true_poses())
EVERYWHERE = np.ones(N_POSES, np.bool_)


def points_on_planes(number: int, seed: int = 0) -> np.ndarray:
    """Return points at depths of 3 to 6 m: (number, 3)."""
    return np.random.default_rng(seed).uniform([-2, -1.5, 3], [2, 1.5, 6], (number, 3))


def test_between_maps_pixels_as_the_two_cameras_do() -> None:
    points, (here, there) = points_on_planes(50), true_poses()[[0, -1]]
    turn, shift = between(here, there, MATRIX)
    pixels = projected(np.repeat(here[None], 50, axis=0), points, MATRIX)
    inverse_depth = 1 / (points @ here[:, :3].T + here[:, 3])[:, 2:]
    mapped = np.concatenate([pixels, np.ones((50, 1))], axis=1) @ turn.T + inverse_depth * shift
    expected = projected(np.repeat(there[None], 50, axis=0), points, MATRIX)
    np.testing.assert_allclose(mapped[:, :2] / mapped[:, 2:], expected, atol=1e-9)


def test_frames_merge_sharp_through_depth_and_blurred_without() -> None:
    # At the true depth, the average of frames from many places is as sharp as a frame.
    source, group, instant = capture(), Group(FrameSpan(0, 320), 159.5), TRUE.at([159.5])[0]
    edges = {}
    for name, depth in (("true", 3.0), ("wrong", 5.0)):
        plane = np.full(POSES_SHAPE, 1 / depth, np.float32)
        found = merge_through_depth(source, group, TRUE, plane, CAMERA)
        assert found.exposure.weight.max() == pytest.approx(320, rel=1e-3)
        np.testing.assert_array_equal(found.pose, instant)
        # The rectangle at 3 m lies about here.
        edges[name] = float(np.nanstd(found.exposure.flux[80:100, 75:115]))
    assert edges["true"] > 1.5 * edges["wrong"], edges


def trembling(rms_px: float) -> tuple[Path, np.ndarray]:
    """Return a path that misses a tremor, and the tremor: rotation vectors of the camera, (N_POSES, 3)."""
    frames = np.arange(N_POSES)
    turns = [np.sin(2 * np.pi * (frames / period + phase)) for period, phase in ((41, 0.1), (27, 0.4), (35, 0.7))]
    tremor = np.sqrt(2) * rms_px / FOCAL_PX * np.stack(turns, axis=1)
    return TRUE.rotated(-tremor), tremor


def test_tremor_within_a_group_is_found() -> None:
    path, tremor = trembling(1.0)
    with ThreadPoolExecutor(2) as pool:
        merged = merge(capture(), resample(EVERYWHERE, 160), Scene(path, EVERYWHERE, _seen_points()), CAMERA, pool)
    left, before = (np.sqrt(np.mean(moves(each.poses, true_poses())[:, :3] ** 2, axis=0)) for each in (merged.path, path))
    np.testing.assert_allclose(before, np.sqrt(np.mean(tremor**2, axis=0)), rtol=0.02)
    assert (left < 0.3 * before).all(), left / before


def estimate_of(*views: PosedView) -> PoseEstimate:
    """The true poses of all frames, and the points of the scene."""
    std, points = np.full(N_POSES, 1e-3), ScenePoints(_seen_points(), np.ones(450, np.float32))
    return PoseEstimate(MATRIX, np.zeros(4), 0.0, TRUE.poses, EVERYWHERE, std, std, points, views)


def test_groups_are_merged_through_dense_depth_where_it_is_known() -> None:
    [pose], depth = TRUE.at([79.5]), np.full(POSES_SHAPE, 0.25, np.float32)
    depth[:, :80] = np.nan
    view = PosedView(FrameSpan(0, 160), 79.5, pose, np.zeros(0, np.intp), np.zeros((0, 2)), lambda: depth)
    dense = replace(estimate_of(view), depth=(DepthMap(0, *5 * (depth,)),))
    sparse = Scene(TRUE, EVERYWHERE, _seen_points())
    with ThreadPoolExecutor(2) as pool:
        merged = [
            merge(capture(), resample(EVERYWHERE, 160), scene, CAMERA, pool) for scene in (sparse, replace(sparse, dense=dense))
        ]
    [before, after] = (each.exposures[0].inverse_depth for each in merged)
    np.testing.assert_allclose(after[:, 80:], 0.25)
    np.testing.assert_array_equal(after[:, :80], before[:, :80])


def test_noise_of_located_groups_does_not_move_the_path() -> None:
    # Observations with noise move exposures; along a path that is right, only what exceeds this noise is a correction.
    rng, points = np.random.default_rng(5), points_on_planes(150, seed=2)
    with ThreadPoolExecutor(2) as pool:
        merged = merge(capture(), resample(EVERYWHERE, 16), Scene(TRUE, EVERYWHERE, _seen_points()), CAMERA, pool)
    groups = [each.exposure.group for each in merged.exposures]
    poses = TRUE.at([group.reference for group in groups])
    views, numbers = (each.ravel() for each in np.meshgrid(np.arange(20), np.arange(150), indexing="ij"))
    pixels = projected(poses[views], points[numbers], MATRIX) + rng.normal(0, 0.3, (3000, 2))
    observations = Observations(numbers, views, pixels, np.tile(0.3**2 * np.eye(2), (3000, 1, 1)))
    level = interpolate(
        groups, Merged(merged.exposures, TRUE, None), points, observations=observations, camera=CAMERA, finds_focal=False
    )
    located = _after_similarity(positions_of(level.adjusted.poses), positions_of(poses))
    path = _after_similarity(positions_of(level.path.at([group.reference for group in groups])), positions_of(poses))
    assert np.sqrt(np.mean(path**2)) < 0.7 * np.sqrt(np.mean(located**2)), (path, located)


def test_adjustment_finds_poses_and_knows_its_errors() -> None:
    rng = np.random.default_rng(1)
    true, points = true_poses()[::16], points_on_planes(150, seed=2)
    errors, expected = [], []
    for _ in range(3):
        views, numbers = (each.ravel() for each in np.meshgrid(np.arange(20), np.arange(150), indexing="ij"))
        pixels = projected(true[views], points[numbers], MATRIX) + rng.normal(0, 0.1, (3000, 2))
        observations = Observations(numbers, views, pixels, np.tile(0.1**2 * np.eye(2), (3000, 1, 1)))
        start = posed(rotation_matrices(rng.normal(0, 0.003, (20, 3))) @ true[:, :, :3], positions_of(true))
        found = adjust(start, points + rng.normal(0, 0.02, points.shape), observations, CAMERA, finds_focal=False)
        errors.append(_after_similarity(positions_of(found.poses), positions_of(true)))
        expected.append(found.std_position)
        assert found.confirmed.mean() > 0.95
        assert found.residual_px == pytest.approx(0.1 * np.sqrt(2 * np.log(2)), rel=0.1)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(expected)))
    assert 0.5 < ratio < 1.5, ratio


def test_exposures_along_the_true_path_are_found_where_they_are() -> None:
    source, groups = capture(), resample(EVERYWHERE, 40)
    with ThreadPoolExecutor(2) as pool:
        merged = merge(source, groups, Scene(TRUE, EVERYWHERE, _seen_points()), CAMERA, pool)
        points, observations = locate(merged.exposures, CAMERA, pool)
    poses = merged.path.at([group.reference for group in groups])
    away = observations.pixels - projected(poses[observations.views], points[observations.points], MATRIX)
    assert len(observations.points) > 500
    assert np.median(np.linalg.norm(away, axis=1)) < 0.5


def test_lens_is_undone_and_images_nothing_beyond_the_frame() -> None:
    camera = Camera(MATRIX, np.array([-0.3, 0.05, 0.01, -0.02]))
    lens = lens_of(camera, POSES_SHAPE)
    for x, y in ((0, 0), (159, 0), (80, 64), (3, 120)):
        np.testing.assert_allclose(imaged(lens, *lens.ideal[y, x]), (x, y), atol=1e-9)
        moved = camera.distorted(lens.ideal[y, x] + (0.01, -0.02)) - (x, y)
        np.testing.assert_allclose(lens.slopes[y, x] @ (0.01, -0.02), moved, atol=1e-5)
    # Beyond the fold of this barrel, a formula alone would image points again.
    assert np.isnan(imaged(lens, 900.0, 63.5)).all()


def test_frames_from_one_place_merge_as_they_are_through_a_lens() -> None:
    source, rests = capture(distortion=LENS), Path(np.repeat(true_poses()[:1], N_POSES, axis=0))
    found = merge_through_depth(source, Group(FrameSpan(0, 8), 3.5), rests, np.full(POSES_SHAPE, 0.2, np.float32), LENS_CAMERA)
    np.testing.assert_allclose(found.exposure.weight[1:-1, 1:-1], 8, atol=1e-4)
    counts = source.frames(FrameSpan(0, 8)).sum(axis=0)
    unsaturated = counts < 8
    unsaturated[[0, -1]] = unsaturated[:, [0, -1]] = False
    expected = source.response.flux(counts / np.float32(8), 8.0)
    np.testing.assert_allclose(found.exposure.flux[unsaturated], expected[unsaturated], atol=1e-3)


def observed_through(camera: Camera, noise_px: float = 0.03) -> tuple[np.ndarray, np.ndarray, Observations]:
    """Return poses, points, and where a camera sees the points, taken as ideal pixels."""
    rng = np.random.default_rng(6)
    poses, points = true_poses()[::16], points_on_planes(150, seed=2)
    views, numbers = (each.ravel() for each in np.meshgrid(np.arange(20), np.arange(150), indexing="ij"))
    pixels = camera.distorted(projected(poses[views], points[numbers], camera.matrix)) + rng.normal(0, noise_px, (3000, 2))
    return poses, points, Observations(numbers, views, pixels, np.tile(noise_px**2 * np.eye(2), (3000, 1, 1)))


def test_adjustment_finds_the_focal_length() -> None:
    poses, points, observations = observed_through(CAMERA)
    found = adjust(poses, points, observations, Camera.of(1.04 * FOCAL_PX, POSES_SHAPE), finds_focal=True)
    assert found.std_focal_px < 0.7
    assert abs(found.focal_px - FOCAL_PX) < 3 * found.std_focal_px
    given = adjust(poses, points, observations, CAMERA, finds_focal=False)
    assert (given.focal_px, given.std_focal_px) == (FOCAL_PX, 0)


@pytest.mark.parametrize("given", [LENS, (0.0, 0.0, 0.0, 0.0)], ids=["right", "wrong"])
def test_lens_is_seen_through_and_a_wrong_one_is_doubted(given: tuple[float, float, float, float]) -> None:
    source = capture(distortion=LENS)
    config, context = StratifiedPoseConfig(group_size=20, levels=2), StageContext(source.info, source.response, 0, 2)
    estimate = StratifiedEstimator(config, context).estimate(source, CameraGuess(FOCAL_PX, distortion=given), Quiet())
    score = pose_errors(estimate.camera_from_world, true_poses(), estimate.located, 10, estimate.std_position)
    if given == LENS:
        assert score.ate_share < 0.005
        assert score.turns_deg < 0.15
        assert estimate.doubts == ()
        assert estimate.residual_ratio is not None
        assert 0 < estimate.residual_ratio < 0.8
        view = estimate.views[8]
        seen = projected(
            np.repeat(view.camera_from_world[None], len(view.xy), axis=0), estimate.points.positions[view.points], MATRIX
        )
        assert np.median(np.linalg.norm(LENS_CAMERA.distorted(seen) - view.xy, axis=1)) < 0.5
    else:
        [doubt] = estimate.doubts
        assert doubt.what == "the exposures contradict the lens"
        assert doubt.where.startswith("a k1 of about -0.")


def test_errors_of_averages_count_only_where_these_contradict_the_focal_length() -> None:
    averages = estimate_of()
    contradicted = FreeFocal(2 * FOCAL_PX, 1.0, np.arange(1), TRUE.poses[:1]).doubt_of(FOCAL_PX, "averages")
    reversed_depth = Reason("the depth of the scene may be reversed", 0.96, 0.9, "", "")
    assert contradicted is not None
    assert is_far_off(replace(averages, doubts=(reversed_depth, contradicted)))
    assert not is_far_off(replace(averages, doubts=(reversed_depth,)))


def test_poses_expect_the_error_of_a_wrong_focal_length() -> None:
    poses, points, observations = observed_through(CAMERA)
    wrong, images = Camera.of(1.06 * FOCAL_PX, POSES_SHAPE), np.arange(len(poses))
    given = adjust(poses, points, observations, wrong, finds_focal=False)
    free = adjust(given.poses, given.points, observations, wrong, finds_focal=True)
    known = FreeFocal(free.focal_px, max(free.std_focal_px, 0.01 * FOCAL_PX), images, free.poses)
    doubt = known.doubt_of(wrong.focal_px, "exposures")
    assert doubt is not None
    assert doubt.what == "the exposures contradict the focal length"
    expected, _ = known.missed(images, given.poses, wrong.focal_px)
    errors = _after_similarity(positions_of(given.poses), positions_of(poses))
    assert np.sqrt(np.mean(errors**2) / np.mean(expected**2)) == pytest.approx(1, abs=0.3)


def _seen_points() -> np.ndarray:
    """Return points on the planes of the capture: (N, 3)."""
    rng, parts = np.random.default_rng(0), []
    for depth, (left, top, right, bottom) in (
        (6.0, (-4, -4, 4, 4)),
        (3.5, (-1.6, -1.0, -0.5, 0.6)),
        (3.0, (-0.3, 0.2, 1.0, 1.1)),
    ):
        parts.append(rng.uniform([left, top, depth], [right, bottom, depth], (150, 3)))
    return np.concatenate(parts)


def _after_similarity(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the distances of places after the best similarity (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), true - true.mean(axis=0)
    left, values, right = np.linalg.svd(b.T @ a)
    signs = np.diag([1, 1, np.sign(np.linalg.det(left @ right))])
    scale = np.trace(np.diag(values) @ signs) / (a**2).sum()
    return np.linalg.norm(scale * a @ (left @ signs @ right).T - b, axis=1)
