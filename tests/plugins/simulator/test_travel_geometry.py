"""Rendered planes, depth and flow against closed forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import apply, camera_matrix, corners, rotation_matrices
from photonpano_simulator.travel.planes import Planes, Scene, trace
from photonpano_simulator.travel.rendering import View, atlas_of
from photonpano_simulator.travel.truth import TravelTruth, depth, flow, sharp_view

SHAPE = (48, 64)
K = camera_matrix(60.0, (31.5, 23.5))
AHEAD = np.eye(4)[:3]


def pose(turn: tuple[float, float, float], centre: tuple[float, float, float]) -> np.ndarray:
    """Return the pose of a camera at `centre`, turned by a rotation vector."""
    rotation = rotation_matrices(turn)
    return np.concatenate([rotation, -rotation @ np.array(centre)[:, None]], axis=1)


def planes(*sheets: tuple, is_disc: bool = False, velocity: tuple[float, float, float] = (0, 0, 0)) -> Planes:
    corner, along, down = np.moveaxis(np.array(sheets, float), 1, 0)
    moves = np.zeros_like(corner)
    moves[-1] = velocity
    return Planes(corner, along, down, moves, np.arange(len(corner)) == (len(corner) - 1 if is_disc else -1))


def wall(width: float, height: float, distance: float, x: float = 0.0, y: float = 0.0) -> tuple:
    """Return a rectangle that faces the first camera."""
    return (x - width / 2, y - height / 2, distance), (width, 0, 0), (0, height, 0)


@pytest.fixture
def truth() -> Callable[..., TravelTruth]:
    """Return a truth of some planes with noise on them, and of some poses."""

    def make(scene: Planes, *poses: np.ndarray) -> TravelTruth:
        rng = np.random.default_rng(0)
        textures = tuple(rng.random((40, 50)).astype(np.float16) for _ in range(len(scene)))
        n = len(poses)
        return TravelTruth(np.stack(poses), K, SHAPE, np.arange(n), np.ones(n), Scene(scene, textures), 0.5)

    return make


def view(scene: Planes, *textures: np.ndarray) -> View:
    return View(scene, atlas_of(tuple(each.astype(np.float16) for each in textures)), K, SHAPE)


def test_two_views_of_a_plane_differ_by_its_homography(truth) -> None:
    first, second = pose((0.02, -0.03, 0.05), (0.1, 0, 0)), pose((-0.05, 0.04, -0.02), (-0.1, 0.05, 0.2))
    found = flow(truth(planes(wall(20, 20, 4.0)), first, second), 0, 1)
    rotation = second[:, :3] @ first[:, :3].T
    shift = second[:, 3] - rotation @ first[:, 3]
    normal = first[:, :3] @ (0, 0, 1)
    distance = 4.0 - (-first[:, :3].T @ first[:, 3])[2]
    homography = K @ (rotation + np.outer(shift, normal) / distance) @ np.linalg.inv(K)
    expected = apply(homography, corners(SHAPE)) - corners(SHAPE)
    at = corners(SHAPE).astype(int)
    np.testing.assert_allclose(found.vectors[at[:, 1], at[:, 0]], expected, atol=1e-9)


def test_depth_of_a_frontal_plane_is_its_distance(truth) -> None:
    found = depth(truth(planes(wall(1.04, 20, 4.0)), AHEAD), 0)
    # It is 15.6 px wide, around pixel 31.5.
    assert found[:, 24:40] == pytest.approx(4.0)
    assert np.isinf(found[:, :24]).all()
    assert np.isinf(found[:, 40:]).all()


def test_flow_hides_what_a_nearer_plane_covers(truth) -> None:
    scene = planes(wall(20, 20, 6.0), wall(1.0, 1.0, 2.0))
    found = flow(truth(scene, AHEAD, pose((0, 0, 0), (0.2, 0, 0))), 0, 1)
    # The near square covers columns 16.5 to 46.5 of frame 0. It moves 6 px to the left, the background 2 px.
    np.testing.assert_allclose(found.vectors[23, [31, 5]], [[-6, 0], [-2, 0]], atol=1e-9)
    hidden = ~found.visible[23]
    # Background at columns below 16.5 goes to x - 2, under the square from 10.5 on: columns from 12.5 to 16.5 are hidden.
    assert np.flatnonzero(hidden).tolist() == [0, 1, 13, 14, 15, 16]
    assert (~found.visible[2]).sum() == 2


def test_flow_follows_what_moves_on_its_own(truth) -> None:
    scene = planes(wall(20, 20, 6.0), wall(1.0, 1.0, 2.0), velocity=(0.1, 0, 0))
    found = flow(truth(scene, AHEAD, AHEAD), 0, 1)
    np.testing.assert_allclose(found.vectors[23, 31], (3, 0), atol=1e-9)
    assert np.abs(found.vectors[2]).max() < 1e-9
    assert np.flatnonzero(~found.visible[23]).tolist() == [47, 48, 49]


def test_flow_to_the_same_frame_is_zero_and_all_is_seen(truth) -> None:
    scene = planes(wall(20, 20, 6.0), wall(1.0, 1.0, 2.0), ((-1, 1, 6), (4, 0, -3), (0, -0.5, 0.2)))
    found = flow(truth(scene, pose((0.1, 0.2, 0.3), (0.1, 0.2, 0.3))), 0, 0)
    assert np.abs(found.vectors).max() < 1e-9
    assert found.visible.all()


def test_planes_are_seen_from_one_side() -> None:
    there, along, down = wall(20, 20, 4.0)
    turned = (np.add(there, along), np.negative(along), down)
    texture = np.ones((2, 2))
    assert view(planes((there, along, down)), texture).flux(AHEAD, 0).min() == 1
    assert not view(planes(turned), texture).flux(AHEAD, 0).any()


def test_pixels_at_an_edge_mix_what_they_see() -> None:
    # The near plane begins at pixel 40: it covers columns from 40, and half of column 40 is 0.5 of it.
    near = (0.5 * 8.5 / 15, -5, 2.0), (5, 0, 0), (0, 10, 0)
    seen = view(planes(wall(20, 20, 6.0), near), np.full((2, 2), 0.25), np.ones((2, 2))).flux(AHEAD, 0)
    assert seen[:, :40] == pytest.approx(0.25)
    assert seen[:, 40] == pytest.approx(0.625)
    assert seen[:, 41:] == pytest.approx(1.0)


def test_a_disc_covers_its_area() -> None:
    scene = planes(wall(20, 20, 6.0), wall(1.4, 1.0, 2.0, x=0.06, y=-0.03), is_disc=True)
    seen = view(scene, np.zeros((2, 2)), np.ones((2, 2))).flux(pose((0, 0, 0.4), (0, 0, 0)), 0)
    # Its diameter is 1 m, the shorter side: 30 px.
    assert seen.sum() == pytest.approx(np.pi * 15**2, rel=2e-3)


def test_a_texture_finer_than_pixels_is_averaged() -> None:
    rng = np.random.default_rng(1)
    fine = rng.integers(0, 2, (960, 1280)).astype(float)
    scene = planes(((-2, -1, 1.5), (6.4, 0, 6.4), (0, 4.8, 0)))
    seen = view(scene, fine).flux(AHEAD, 0)
    whole = seen[12:40, 20:50]
    assert whole.mean() == pytest.approx(0.5, abs=0.01)
    # A sample of one texel would have the standard deviation 0.5.
    assert whole.std() < 0.06


def test_flux_of_a_pixel_is_the_mean_over_its_area() -> None:
    # Stripes of 8 px: the mean of a sine over a pixel is smaller by sinc(1/8).
    scene = planes(wall(64 / 60 * 2, 48 / 60 * 2, 2.0))
    x = (np.arange(640) + 0.5) / 640 * 64
    stripes = np.broadcast_to(0.5 + 0.4 * np.sin(2 * np.pi * x / 8), (480, 640))
    seen = view(scene, stripes).flux(AHEAD, 0)
    expected = 0.5 + 0.4 * np.sinc(1 / 8) * np.sin(2 * np.pi * (np.arange(64) + 0.5) / 8)
    contrast = np.polyfit(expected[4:-4] - 0.5, seen[24, 4:-4] - 0.5, 1)[0]
    assert 0.9 < contrast < 1.02
    assert seen[8:40, 8:56].mean() == pytest.approx(0.5, abs=2e-3)


def test_rendering_agrees_with_the_nearest_plane_of_each_ray() -> None:
    rng = np.random.default_rng(3)
    sheets = [wall(20, 20, 9.0)]
    for _ in range(12):
        along, down = rng.normal(0, 1, 3), rng.normal(0, 1, 3)
        sheets.append((rng.uniform((-2, -2, 3), (2, 2, 7)), along, down))
    scene = planes(*sheets, is_disc=True)
    there = pose((0.1, -0.1, 0.2), (0.1, 0.2, -0.1))
    seen = view(scene, *(np.full((2, 2), each) for each in range(len(sheets)))).flux(there, 0)
    points = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1).reshape(-1, 2)
    owner, inverse_depth = np.empty(len(points), np.int32), np.empty(len(points))
    trace(points, scene.maps(there, K, 0.0), scene.radii, owner, inverse_depth)
    assert len(np.unique(owner)) > 4
    agrees = np.isclose(seen.ravel(), owner)
    # Pixels at edges are mixed.
    assert agrees.mean() > 0.85
    inside = (
        owner.reshape(SHAPE)[1:-1, 1:-1, None]
        == np.stack([owner.reshape(SHAPE)[1 + y : 47 + y, 1 + x : 63 + x] for x in (-1, 0, 1) for y in (-1, 0, 1)], axis=-1)
    ).all(axis=-1)
    assert agrees.reshape(SHAPE)[1:-1, 1:-1][inside].mean() > 0.995


def test_sharp_views_do_not_depend_on_the_threads_that_render(truth) -> None:
    made = truth(planes(wall(20, 20, 6.0), wall(1.0, 1.0, 2.0)), AHEAD, pose((0, 0, 0.1), (0, 0.1, 0)))
    np.testing.assert_array_equal(sharp_view(made, 1), sharp_view(made, 1))
    assert sharp_view(made, 0).mean() == pytest.approx(0.25, abs=0.02)
