"""Poses through the depth of the scene: each step against known truth."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from photonpano import CameraGuess, FrameSpan, Group, LocationError, StageContext
from photonpano.contracts.requirements import require_poses
from photonpano.evaluation import pose_errors
from photonpano.execution.context import Quiet
from photonpano.geometry import Camera, positions_of, rotation_matrices
from photonpano.testing import MemorySource
from photonpano.testing.motions import FOCAL_PX, N_POSES, POSES_SHAPE, capture, true_poses

pytest.importorskip("pycolmap")
pytest.importorskip("gtsam")

from photonpano_colmap.exposures import (
    Path,
    PoseSpline,
    _beyond_noise,
    between,
    find_tremor,
    imaged,
    inverse_depth_of,
    lens_of,
    merge_through_depth,
    moves,
    posed,
    projected,
)
from photonpano_colmap.hooks import StratifiedPoseConfig
from photonpano_colmap.locating import Found, Observations, Patches, adjust, find_patches
from photonpano_colmap.stratified import Merged, Scene, StratifiedEstimator, interpolate, locate, merge, resample

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


def test_inverse_depth_of_a_plane_is_exact_between_points() -> None:
    normal, pose = np.array([0.1, -0.05, 0.25]), true_poses()[40]
    rays = np.concatenate([np.random.default_rng(0).uniform(-0.6, 0.6, (300, 2)), np.ones((300, 1))], axis=1)
    points = (rays / (rays @ normal)[:, None] - pose[:, 3]) @ pose[:, :3]
    found = inverse_depth_of(pose, points, CAMERA, POSES_SHAPE)
    y, x = np.mgrid[20:108, 20:140]
    expected = ((x - 79.5) * normal[0] + (y - 63.5) * normal[1]) / FOCAL_PX + normal[2]
    assert found is not None
    np.testing.assert_allclose(found[20:108, 20:140], expected, rtol=0.02)
    assert inverse_depth_of(pose, points[:3], CAMERA, POSES_SHAPE) is None


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


def test_path_is_interpolated_between_frames_and_rests_beyond() -> None:
    spline = PoseSpline(np.arange(N_POSES, dtype=float), true_poses())
    np.testing.assert_allclose(TRUE.at([0, 7]), true_poses()[[0, 7]], atol=1e-12)
    np.testing.assert_allclose(TRUE.at([3.5, 100.25]), spline.at([3.5, 100.25]), atol=1e-4)
    np.testing.assert_allclose(TRUE.at([-5, 400]), true_poses()[[0, -1]], atol=1e-12)


def test_corrected_path_has_the_means_at_which_its_groups_were_located() -> None:
    borders = np.linspace(0, 320, 17)
    frames = np.arange(320)
    turns = 0.01 * np.stack([np.sin(frames / 15), np.cos(frames / 19), np.sin(frames / 16)], axis=1)
    shifts = 0.02 * np.stack([np.cos(frames / 17), np.sin(frames / 18), np.sin(frames / 14)], axis=1)
    expected = posed(rotation_matrices(turns) @ true_poses()[:, :, :3], positions_of(true_poses()) + shifts)
    means = np.concatenate([turns, shifts], axis=1).reshape(16, 20, 6).mean(axis=1)
    instants = (borders[:-1] + borders[1:] - 1) / 2
    through = np.stack([np.interp(frames, instants, each) for each in means.T], axis=1)
    errors = [
        np.linalg.norm(moves(poses, expected)[40:-40, 3:], axis=1).max()
        for poses in (
            TRUE.corrected(borders - 0.5, means).poses,
            posed(rotation_matrices(through[:, :3]) @ true_poses()[:, :, :3], positions_of(true_poses()) + through[:, 3:]),
        )
    ]
    # A curve through the means as if they were instants loses some of the motion.
    assert errors[0] < 0.4 * errors[1], errors


def test_noise_of_the_outermost_groups_is_not_magnified_at_the_ends() -> None:
    means = 1e-4 * np.random.default_rng(0).normal(size=(20, 6))
    exact, noisy = (TRUE.corrected(np.linspace(0, 320, 21) - 0.5, each).poses for each in (0 * means, means))
    assert abs(moves(exact, noisy)[[0, -1]]).max() < 5e-4


def test_corrected_path_keeps_no_motion_within_groups_that_was_only_interpolated() -> None:
    wrong = 0.01 * (np.arange(320) % 16 - 7.5)[:, None] / 8
    start = Path(posed(true_poses()[:, :, :3], positions_of(true_poses()) + wrong))
    found = start.corrected(np.linspace(0, 320, 21) - 0.5, np.zeros((20, 6)))
    np.testing.assert_allclose(positions_of(found.poses), positions_of(true_poses()), atol=2e-3)


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


def test_steady_path_has_no_tremor() -> None:
    with ThreadPoolExecutor(2) as pool:
        merged = merge(capture(), resample(EVERYWHERE, 160), Scene(TRUE, EVERYWHERE, _seen_points()), CAMERA, pool)
        found = find_tremor(capture(), merged.exposures, TRUE, CAMERA, pool)
        short = merge(capture(), resample(EVERYWHERE, 40)[:2], Scene(TRUE, EVERYWHERE, _seen_points()), CAMERA, pool)
    assert found is not None
    assert found.rms_px < 0.15
    assert found.std.max() < np.deg2rad(0.1)
    assert short.tremor is None
    assert short.path is TRUE


def test_shifts_beyond_white_noise_are_told() -> None:
    rng, spans = np.random.default_rng(0), np.arange(1600)
    noise = rng.normal(0, 0.1, (1600, 2))
    trembling = np.stack([np.sin(spans / 3), np.sin(spans / 5 + 1)], axis=1) * np.sqrt(2) * 0.05
    assert _beyond_noise(noise) < 0.04
    # 0.05 px along each of three axes
    assert _beyond_noise(noise + trembling) == pytest.approx(np.sqrt(3) * 0.05, rel=0.2)


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
    level = interpolate(groups, Merged(merged.exposures, TRUE, None), points, observations, CAMERA, finds_focal=False)
    located = _after_similarity(positions_of(level.adjusted.poses), positions_of(poses))
    path = _after_similarity(positions_of(level.path.at([group.reference for group in groups])), positions_of(poses))
    assert np.sqrt(np.mean(path**2)) < 0.7 * np.sqrt(np.mean(located**2)), (path, located)


def test_groups_cover_the_located_frames_only() -> None:
    located = EVERYWHERE.copy()
    located[100:150] = False
    spans = [group.span for group in resample(located, 40)]
    assert [(span.start, span.stop) for span in spans] == [(0, 50), (50, 100), (150, 192), (192, 235), (235, 278), (278, 320)]


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


def test_patches_at_edges_of_things_count_less() -> None:
    # Observations of a tenth of the points wander with the view, as those of two depths at once do.
    rng = np.random.default_rng(3)
    true, points = true_poses()[::16], points_on_planes(150, seed=2)
    views, numbers = (each.ravel() for each in np.meshgrid(np.arange(20), np.arange(150), indexing="ij"))
    pixels = projected(true[views], points[numbers], MATRIX) + rng.normal(0, 0.05, (3000, 2))
    pixels[numbers < 15, 0] += 0.15 * (views[numbers < 15] - 10)
    observations = Observations(numbers, views, pixels, np.tile(0.05**2 * np.eye(2), (3000, 1, 1)))
    found = adjust(true, points, observations, CAMERA, finds_focal=False)
    error = _after_similarity(positions_of(found.poses), positions_of(true))
    assert np.sqrt(np.mean(error**2)) < 0.003, error
    assert found.confirmed[15:].mean() > 0.9


def test_exposures_along_the_true_path_are_found_where_they_are() -> None:
    source, groups = capture(), resample(EVERYWHERE, 40)
    with ThreadPoolExecutor(2) as pool:
        merged = merge(source, groups, Scene(TRUE, EVERYWHERE, _seen_points()), CAMERA, pool)
        points, observations = locate(merged.exposures, CAMERA, pool)
    poses = merged.path.at([group.reference for group in groups])
    away = observations.pixels - projected(poses[observations.views], points[observations.points], MATRIX)
    assert len(observations.points) > 500
    assert np.median(np.linalg.norm(away, axis=1)) < 0.5


def test_exposures_without_anything_in_common_are_an_error() -> None:
    source = MemorySource(np.random.default_rng(0).integers(0, 2, (40, *POSES_SHAPE)))
    with ThreadPoolExecutor(2) as pool:
        everywhere = np.ones(40, np.bool_)
        merged = merge(source, resample(everywhere, 20), Scene(TRUE, everywhere, _seen_points()), CAMERA, pool)
        with pytest.raises(LocationError, match="no patch of one was found in another"):
            locate(merged.exposures, CAMERA, pool)


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


@pytest.mark.parametrize("k1", [0.0, -0.02, 0.02])
def test_adjustment_tells_distortion_that_is_not_that_of_the_lens(k1: float) -> None:
    poses, points, observations = observed_through(Camera(MATRIX, np.array([k1, 0, 0, 0])))
    found = adjust(poses, points, observations, CAMERA, finds_focal=False)
    assert found.std_k1 < 0.003
    assert abs(found.missed_k1 - k1) < 3 * found.std_k1 + 0.1 * abs(k1), (found.missed_k1, found.std_k1)


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


def test_frames_that_show_nothing_are_lost_and_the_others_refined() -> None:
    frames = capture().frames(FrameSpan(0, N_POSES)).copy()
    frames[140:160] = 0
    source = MemorySource(frames)
    config, context = StratifiedPoseConfig(group_size=20, levels=2), StageContext(source.info, source.response, 0, 2)
    estimate = StratifiedEstimator(config, context).estimate(source, CameraGuess(FOCAL_PX), Quiet())
    lit = frames.any(axis=(1, 2))
    np.testing.assert_array_equal(estimate.located, lit)
    assert np.isnan(estimate.camera_from_world[~lit]).all()
    assert [each.span for each in estimate.lost] == [FrameSpan(140, 160)]
    score = pose_errors(estimate.camera_from_world, true_poses(), lit, 10, estimate.std_position)
    assert score.ate_share < 0.01
    assert score.turns_deg < 0.3
    assert score.honest_shares is not None
    assert score.honest_shares[2] > 0.9


def test_frames_that_an_early_level_does_not_locate_are_lost_and_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(patches: Patches, here: Any, there: Any, camera: Camera) -> Found:
        each = find_patches(patches, here, there, camera)
        span = there[0].exposure.group.span
        return Found(*(part[:0] for part in each)) if span.start <= 150 < span.stop else each

    monkeypatch.setattr("photonpano_colmap.stratified.find_patches", found)
    source, config = capture(), StratifiedPoseConfig(group_size=20, levels=3)
    context = StageContext(source.info, source.response, 0, 2)
    estimate = StratifiedEstimator(config, context).estimate(source, CameraGuess(FOCAL_PX), Quiet())
    assert require_poses(estimate, source) is estimate
    assert [each.span for each in estimate.lost] == [FrameSpan(140, 160)]
    np.testing.assert_array_equal(np.flatnonzero(~estimate.located), np.arange(140, 160))


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
