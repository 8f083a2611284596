"""Depth of all pixels, against the planes of a scene."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from photonpano import FrameSpan
from photonpano.execution.context import Quiet
from photonpano.geometry import Camera
from photonpano_poses import PosedView, PoseEstimate, ScenePoints, see_depth, with_depth
from photonpano_poses import depth as depth_module
from photonpano_poses.depth import fused
from photonpano_poses.files import splats_ply
from photonpano_poses.page import depth_source
from photonpano_poses.run import depth_record, judge_poses
from photonpano_poses.testing import FOCAL_PX, N_POSES, PLANES, POSES_SHAPE, capture, true_poses

CAMERA = Camera.of(FOCAL_PX, POSES_SHAPE)
GROUP = 10


def true_depth(pose: np.ndarray) -> np.ndarray:
    """Return the depth of the planes at the pixels of a frame, (H, W); 0 where there is none."""
    height, width = POSES_SHAPE
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones(POSES_SHAPE)], axis=-1)
    rays = pixels @ np.linalg.inv(CAMERA.matrix).T
    world, place, nearest = rays @ pose[:, :3], -pose[:, :3].T @ pose[:, 3], np.full(POSES_SHAPE, np.inf)
    for depth, (left, top, right, bottom) in PLANES:
        along = (depth - place[2]) / world[..., 2]
        x, y = np.moveaxis((place + along[..., None] * world)[..., :2], -1, 0)
        hit = (x > left) & (x < right) & (y > top) & (y < bottom) & (along < nearest)
        nearest[hit] = along[hit]
    return np.where(np.isfinite(nearest), nearest, 0)


def estimate_of(poses: np.ndarray, every: int = 20, travels: bool = True) -> PoseEstimate:
    """Return an estimate with an exposure of 10 frames in every 20, and points on the planes."""
    source, views = capture(travels), []
    positions = np.concatenate(
        [
            np.stack([*np.random.default_rng(0).uniform((left, top), (right, bottom), (40, 2)).T, np.full(40, depth)], axis=1)
            for depth, (left, top, right, bottom) in PLANES
        ]
    )
    for start in range(0, N_POSES - GROUP + 1, every):
        span = FrameSpan(start, start + GROUP)

        def flux(span: FrameSpan = span) -> np.ndarray:
            return source.response.flux((source.counts(span) / GROUP).astype(np.float32), GROUP)

        views.append(
            PosedView(
                span, span.centre, poses[start + GROUP // 2], np.arange(len(positions)), np.zeros((len(positions), 2)), flux
            )
        )
    everywhere = np.ones(N_POSES, np.bool_)
    points = ScenePoints(positions, np.ones(len(positions), np.float32))
    std = np.full(N_POSES, 1e-3)
    return PoseEstimate(CAMERA.matrix, np.zeros(4), 0.0, poses, everywhere, std, std, points, tuple(views))


@pytest.fixture(scope="module")
def found() -> PoseEstimate:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(depth_module, "_KEYS", 4)
        return with_depth(capture(), estimate_of(true_poses()), 2, Quiet())


def test_depth_is_that_of_the_planes_within_its_error(found: PoseEstimate) -> None:
    errors, sigmas = [], []
    for each in found.depth:
        true = true_depth(found.views[each.view].camera_from_world)
        known = np.isfinite(each.inverse_depth) & (true > 0)
        assert known.mean() > 0.6
        errors.append(np.abs(each.inverse_depth * true - 1)[known])
        sigmas.append((np.abs(each.inverse_depth - 1 / np.where(known, true, 1)) / each.std)[known])
    errors, sigmas = np.concatenate(errors), np.concatenate(sigmas)
    assert np.median(errors) < 0.02
    assert (sigmas < 2).mean() > 0.9, [(sigmas < k).mean() for k in (1, 2, 3)]


def test_depth_of_a_view_between_two_keys_is_that_of_the_nearest(found: PoseEstimate) -> None:
    instant = 57.0  # of no exposure
    pose = true_poses()[int(instant)]
    true = true_depth(pose)
    inverse_depth = np.full(POSES_SHAPE, 1 / 4.5, np.float32)
    see_depth(found, instant, pose, inverse_depth)
    known = (true > 0) & (inverse_depth != np.float32(1 / 4.5))
    assert known.mean() > 0.6
    assert np.median(np.abs(inverse_depth * true - 1)[known]) < 0.03
    see_depth(replace(found, depth=()), instant, pose, before := inverse_depth.copy())
    np.testing.assert_array_equal(before, inverse_depth)


def test_record_judges_by_photons_that_were_left_out(found: PoseEstimate) -> None:
    record = depth_record(found)
    assert record is not None
    assert record["exposures"] == 4
    assert 0 < record["held_out_share"] < 0.13
    assert depth_record(replace(found, depth=())) is None
    assert judge_poses(found).status == "trusted"
    nothing = np.full(POSES_SHAPE, np.nan, np.float32)
    lost = replace(found, depth=(replace(found.depth[0], inverse_depth=nothing, std=nothing),))
    [reason] = judge_poses(lost).reasons
    assert reason.what == "many pixels have no depth"
    assert depth_source(lost) is None
    assert (depth_source(found) or "").startswith("data:image/png;base64,")


def test_photons_that_were_left_out_doubt_a_wrong_depth(found: PoseEstimate, monkeypatch: pytest.MonkeyPatch) -> None:
    best = depth_module._best

    def too_near(total: np.ndarray, cost: np.ndarray, steps: np.ndarray, inverse_depth: np.ndarray, std: np.ndarray) -> None:
        best(total, cost, steps, inverse_depth, std)
        inverse_depth *= np.float32(1.2)

    monkeypatch.setattr(depth_module, "_best", too_near)
    monkeypatch.setattr(depth_module, "_KEYS", 2)
    wrong = with_depth(capture(), replace(found, depth=()), 2, Quiet())
    [reason] = judge_poses(wrong).reasons
    assert reason.what.startswith("photons that were left out prefer another depth")
    assert 0.3 < reason.figure < 0.7


def test_photons_without_light_cannot_judge_depth(found: PoseEstimate) -> None:
    alike = tuple(replace(each, flux_nearer=each.flux, flux_farther=each.flux) for each in found.depth)
    record = depth_record(replace(found, depth=alike))
    assert record is not None
    assert record["held_out_share"] is None
    assert judge_poses(replace(found, depth=alike)).status == "trusted"


def test_surface_lies_on_the_planes_and_faces_the_camera(found: PoseEstimate) -> None:
    surface = fused(found)
    number = len(surface.positions)
    assert 1 < number / np.isfinite(found.depth[0].inverse_depth).sum() < 3.5  # what a key has seen is not told again
    away = np.abs(surface.positions[:, 2:] - [depth for depth, _ in PLANES]).min(axis=1)
    assert np.median(away) < 0.1
    assert np.median(surface.normals[:, 2]) < -0.9
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1)


def test_camera_that_only_turns_sees_no_depth() -> None:
    estimate = estimate_of(true_poses(travels=False), every=60, travels=False)
    found = with_depth(capture(travels=False), estimate, 1, Quiet())
    assert found.depth == ()
    [reason] = judge_poses(found).reasons
    assert reason.what == "the depth is not known"


def test_splats_are_those_of_the_gaussian_convention(found: PoseEstimate) -> None:
    surface = fused(found)
    header, body = splats_ply(surface).split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float")]
    expected = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    assert names == expected.split()
    splats = dict(zip(names, np.frombuffer(body, "<f4").reshape(-1, len(names)).T, strict=True))
    w, x, y, z = (splats[f"rot_{k}"] for k in range(4))
    rotations = Rotation.from_quat(np.stack([x, y, z, w], axis=1)).as_matrix()
    np.testing.assert_allclose(rotations[:, :, 2], surface.normals, atol=1e-5)  # thin along the normal
    across, thickness = np.exp(splats["scale_0"]), np.exp(splats["scale_2"])
    np.testing.assert_allclose(across, surface.sizes / 2, rtol=1e-5)
    np.testing.assert_allclose(thickness, 0.1 * across, rtol=1e-5)
    assert 0.9 < 1 / (1 + np.exp(-splats["opacity"][0])) < 1
    colour = 0.5 + 0.28209479 * splats["f_dc_0"]
    assert -1e-6 < colour.min() < colour.max() < 1 + 1e-6
