"""A camera that travels: rendered planes, depth and flow against closed forms, statistics, paths, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError, SourceContext
from photonpano.geometry import Camera, camera_matrix, corners, positions_of, rotation_matrices, transform_points
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.hooks import photonpano_sources
from photonpano_simulator.paths import camera_path
from photonpano_simulator.travel import TravelSource, TravelTruth, depth, flow, sharp_view, truth_of
from photonpano_simulator.travel_config import TravelConfig
from photonpano_simulator.travel_planes import Planes, Scene, View, atlas_of, trace

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

    def make(scene: Planes, *poses: np.ndarray, distortion: tuple[float, ...] = (0, 0, 0, 0)) -> TravelTruth:
        rng = np.random.default_rng(0)
        textures = tuple(rng.random((40, 50)).astype(np.float16) for _ in range(len(scene)))
        n, camera = len(poses), Camera(K, np.array(distortion))
        return TravelTruth(
            camera_from_world=np.stack(poses),
            camera=camera,
            frame_shape=SHAPE,
            taken=np.arange(n),
            light=np.ones(n),
            scene=Scene(scene, textures),
            flux=0.5,
        )

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
    expected = transform_points(homography, corners(SHAPE)) - corners(SHAPE)
    at = corners(SHAPE).astype(int)
    np.testing.assert_allclose(found.vectors[at[:, 1], at[:, 0]], expected, atol=1e-9)


def test_lens_images_points_as_opencv_does(truth) -> None:
    poses, lens = (
        (pose((0.02, -0.03, 0.05), (0.1, 0, 0)), pose((-0.05, 0.04, -0.02), (-0.1, 0.05, 0.2))),
        (-0.2, 0.05, 0.01, -0.01),
    )
    made = truth_of(truth(planes(wall(40, 40, 6.0), wall(1.0, 1.0, 2.0)), *poses, distortion=lens).arrays())
    found, far = flow(made, 0, 1), depth(made, 0)
    for x, y in ((0, 0), (63, 47), (31, 23), (5, 40)):
        [[[a, b]]] = cv2.undistortPoints(np.array([[[x, y]]], float), K, np.array(lens))
        world = poses[0][:, :3].T @ (far[y, x] * np.array([a, b, 1]) - poses[0][:, 3])
        there, _ = cv2.projectPoints(world, poses[1][:, :3], poses[1][:, 3], K, np.array(lens))
        np.testing.assert_allclose(found.vectors[y, x] + (x, y), there.ravel(), atol=1e-3)


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


(TRAVEL,) = (each for each in photonpano_sources() if each.name == "travel-simulator")
SMALL = {"scene": {"kind": "planes"}, "n_frames": 400, "frame_shape": (40, 52), "focal_px": 40.0}


def config(**settings: Any) -> TravelConfig:
    return TravelConfig.model_validate(SMALL | settings)


@pytest.fixture
def travelling() -> Callable[..., TravelSource]:
    def build(run_seed: int = 0, **settings: Any) -> TravelSource:
        return TravelSource(config(**settings), SourceContext(seed=run_seed))

    return build


def test_frames_are_draws_of_their_sharp_views(travelling) -> None:
    source = travelling(sensor={"dark_rate": 0.02, "gain_std": 0.1}, drift=3.0, n_frames=200)
    truth = source.truth()
    frames = source.frames(FrameSpan(0, 200)).astype(float)
    made = truth_of(truth)
    chances = np.stack([-np.expm1(-(sharp_view(made, k) * truth["gains"] + 0.02)) for k in range(200)])
    spread = np.sqrt((chances * (1 - chances)).sum())
    assert abs(frames.sum() - chances.sum()) < 4 * spread
    standard = (frames - chances) / np.sqrt(chances * (1 - chances))
    assert standard.var() == pytest.approx(1, abs=0.015)
    # Neighbouring frames are independent.
    assert abs((standard[1:] * standard[:-1]).mean()) < 4 / np.sqrt(standard[1:].size)


def test_a_frame_depends_on_seed_and_index_alone(travelling) -> None:
    source, again, other = travelling(run_seed=5), travelling(seed=5), travelling(run_seed=6)
    backwards = [again.frames(FrameSpan(k, k + 1))[0] for k in (9, 3, 0)]
    np.testing.assert_array_equal(source.frames(FrameSpan(0, 10))[[9, 3, 0]], backwards)
    assert (source.frames(FrameSpan(0, 1)) != other.frames(FrameSpan(0, 1))).any()
    kept = travelling(run_seed=5, drops=[{"at": 2, "frames": 3}])
    np.testing.assert_array_equal(kept.frames(FrameSpan(2, 3)), source.frames(FrameSpan(5, 6)))
    assert kept.truth()["taken"][:4].tolist() == [0, 1, 5, 6]


def test_path_has_its_length_and_tremor(travelling) -> None:
    still = travelling(path={"kind": "travel", "length_m": 0.4, "centre": (0.1, 0, -0.2)}).truth()["camera_from_world"]
    tremor = {"rms_px": 2.0, "rms_mm": 3.0, "roll_rms_deg": 0.5, "frequencies_hz": (500, 900, 1300)}
    shaken = travelling(path={"kind": "travel", "length_m": 0.4, "centre": (0.1, 0, -0.2), "tremor": tremor})
    shaken = shaken.truth()["camera_from_world"]
    way = positions_of(still)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(0.4, rel=1e-3)
    np.testing.assert_allclose((way.min(axis=0) + way.max(axis=0)) / 2, (0.1, 0, -0.2), atol=1e-3)
    np.testing.assert_allclose(
        still[:, :, :3] @ np.swapaxes(still[:, :, :3], 1, 2), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-12
    )
    assert np.sqrt(((positions_of(shaken) - way) ** 2).mean(axis=0)) == pytest.approx([0.003] * 3, rel=0.05)
    small = shaken[:, :, :3] @ np.swapaxes(still[:, :, :3], 1, 2)
    assert np.sqrt((small[:, 0, 2] ** 2).mean()) == pytest.approx(2 / 40, rel=0.05)
    assert np.sqrt((small[:, 0, 1] ** 2).mean()) == pytest.approx(np.deg2rad(0.5), rel=0.1)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {"scene": {"kind": "room"}, "path": {"kind": "travel", "centre": (0, 0, 5)}},
            "the camera leaves the scene: it is at (-0.08, -0.04, 4.97) m, 0% of the way along, and may be between "
            "(-2.5, -1.1, -1.8) and (2.5, 1.5, 4.2) m; move path.centre, or shorten the path",
        ),
        (
            {"scene": {"kind": "room"}, "path": {"kind": "travel", "centre": (0.3, 0.75, 2.5), "length_m": 1.5}},
            "the path of the camera passes through a surface of the scene at (0.03, 0.76, 2.46) m, 9% of the way along; "
            "move path.centre, or shorten path.length_m",
        ),
        (
            {"path": {"kind": "turn-only", "degrees": 180}},
            "the camera sees past the end of the scene 0% of the way along: there is nothing at the pixel (0, 0); "
            "move path.look_at to the middle of the scene, or turn by less",
        ),
        (
            {"path": {"kind": "turn-only", "look_at": (0, -3, 0)}},
            "the camera cannot look at (0.00, -3.00, 0.00) m: on its path that is where it is, or straight above or below it; "
            "move path.look_at",
        ),
        (
            {"drops": [{"at": 390, "frames": 20}]},
            "drops names the frames 390 to 409, but the camera takes 400 frames (0 to 399); "
            "shorten the range, or raise n_frames",
        ),
    ],
)
def test_wrong_paths_are_refused_before_anything_is_drawn(settings: dict[str, Any], expected: str) -> None:
    assert list(TRAVEL.check(config(**settings))) == [expected]


def test_homographies_of_a_scene_with_depth_are_refused(travelling, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **travelling(n_frames=5).truth())
    path = {"kind": "file", "file": tmp_path / "a.npz"}
    with pytest.raises(InputError, match=r"a\.npz is the truth of a scene with depth, which has no homographies; take that of"):
        camera_path(SimulatorConfig.model_validate({"path": path, "n_frames": 5}), (1365, 2048), seed=0)
