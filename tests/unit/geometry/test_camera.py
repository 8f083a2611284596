"""Cameras, and canvases around what they see."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.geometry import (
    PROJECTIONS,
    Camera,
    canvas_around,
    canvas_of,
    corners,
    covered_by,
    from_parameters,
    level_horizon,
    likely_rotations,
    nearest_rotations,
    outline_of,
    rotation_matrices,
    rotation_vectors,
    transform_points,
    translation,
)

LENS = (-0.1, 0.02, 1e-3, -2e-3)


def test_distorted_agrees_with_opencv() -> None:
    cv2 = pytest.importorskip("cv2")
    camera = Camera.of(300.0, (254, 496), LENS)
    points = np.random.default_rng(0).uniform((0, 0), (495, 253), (50, 2))
    rays = np.c_[(points - camera.centre_px) / 300.0, np.ones(50)]
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(LENS))[0][:, 0]
    np.testing.assert_allclose(camera.distorted(points), expected, atol=1e-9)


def test_ideal_inverts_distorted() -> None:
    camera = Camera.of(300.0, (254, 496), LENS)
    points = np.random.default_rng(0).uniform((0, 0), (495, 253), (2, 50, 2))
    np.testing.assert_allclose(camera.ideal(camera.distorted(points)), points, atol=1e-9)


def test_ideal_is_nan_where_the_lens_images_nothing() -> None:
    # x (1 - 0.5 x^2) is at most 0.54 focal lengths.
    camera = Camera.of(100.0, (101, 101), (-0.5, 0, 0, 0))
    assert np.isnan(camera.ideal([[50 + 60.0, 50.0]])).all()


def test_homographies_of_rotations_have_determinant_1_at_any_angle() -> None:
    camera = Camera.of(330.0, (254, 496))
    rotations = rotation_matrices([[0, 0.5, 0], [0, np.pi / 2, 0], [0.1, 3.0, 0]])
    homographies = camera.homographies(rotations)
    np.testing.assert_allclose(np.linalg.det(homographies), 1)
    np.testing.assert_allclose(camera.rotations(-2 * homographies), rotations, atol=1e-12)


def test_rotation_vectors_invert_rotation_matrices() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose(rotation_vectors(rotation_matrices(vectors)), vectors, atol=1e-12)


def test_nearest_rotations_ignores_scale_and_small_errors() -> None:
    rotations = rotation_matrices(np.random.default_rng(0).normal(size=(5, 3)))
    np.testing.assert_allclose(nearest_rotations(3 * rotations), rotations, atol=1e-12)


def test_likely_rotations_move_a_frame_by_the_whole_of_a_shift() -> None:
    """The nearest matrices that rotate would move it by half: a shift is no rotation of a plane, and the half is between."""
    camera, frame = Camera.of(4464.0, (254, 496)), corners((254, 496))
    [rotation] = likely_rotations(camera, translation(3.0, -1.0)[None], (254, 496))
    moved = transform_points(camera.homographies(rotation), frame) - frame
    np.testing.assert_allclose(moved, np.broadcast_to([3.0, -1.0], moved.shape), atol=0.03)


SHAPE = (40, 60)
small = st.floats(-0.2, 0.2)
shift = st.floats(-300, 300)
perspective = st.floats(-1e-3, 1e-3)
homographies = st.builds(lambda *p: from_parameters(p), small, small, small, small, shift, shift, perspective, perspective)
motions = st.lists(homographies, min_size=1, max_size=4).map(np.stack)
scales = st.floats(0.05, 16)


@given(motions, scales)
def test_canvas_holds_every_corner_without_spare_rows(motion: np.ndarray, scale: float) -> None:
    canvas = canvas_of(motion, SHAPE, scale)
    placed = transform_points(canvas.transform @ motion, corners(SHAPE)).reshape(-1, 2)
    before = placed.min(axis=0) + 0.5
    after = np.array([canvas.width, canvas.height]) - 0.5 - placed.max(axis=0)
    assert before.min() >= -1e-4
    assert after.min() >= -1e-4
    # The canvas begins and ends with whole reference pixels, and ends with a whole pixel of its own.
    assert before.max() <= 1.5 * scale + 1e-4
    assert after.max() <= 1.5 * scale + 1 + 1e-4


CAMERA = Camera.of(50.0, SHAPE)


def turned(degrees: np.ndarray, pitch: float = 0.0) -> np.ndarray:
    """Return rotations about the vertical, of cameras that look up by `pitch` degrees."""
    about_y = np.stack([np.zeros_like(degrees), np.radians(degrees), np.zeros_like(degrees)], axis=-1)
    return rotation_matrices(about_y) @ rotation_matrices([np.radians(pitch), 0, 0])


@pytest.mark.parametrize("name", PROJECTIONS)
def test_points_of_rays_are_where_they_came_from(name: str) -> None:
    points = np.random.default_rng(0).uniform(-1.4, 1.4, (50, 2))
    rays = PROJECTIONS[name].rays(points)
    assert np.allclose(PROJECTIONS[name].points(3 * rays), points)


def test_projections_follow_their_definition() -> None:
    x, y, z = 0.3, -0.4, -0.5
    ray = np.array([x, y, z])
    assert np.allclose(PROJECTIONS["cylindrical"].points(ray), [np.arctan2(x, z), y / np.hypot(x, z)])
    assert np.allclose(PROJECTIONS["spherical"].points(ray), [np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])
    assert np.isnan(PROJECTIONS["planar"].points(ray)).all()
    across, up = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
    mercator = [across, np.log(np.tan(np.pi / 4 + up / 2))]
    assert np.allclose(PROJECTIONS["mercator"].points(ray), mercator)
    panini = [2 * np.tan(across / 2), 2 * np.tan(up) / (1 + np.cos(across))]
    assert np.allclose(PROJECTIONS["panini"].points(ray), panini)
    away, about = np.arccos(z / np.linalg.norm(ray)), np.arctan2(y, x)
    stereographic = 2 * np.tan(away / 2) * np.array([np.cos(about), np.sin(about)])
    assert np.allclose(PROJECTIONS["stereographic"].points(ray), stereographic)


def test_canvas_of_full_turn_spans_exactly_one_turn() -> None:
    covered = covered_by(turned(np.arange(0.0, 400, 5)), CAMERA, SHAPE)
    canvas = canvas_around(covered, CAMERA, 1.0, "spherical")
    assert covered.full_turn
    assert canvas.period_px == pytest.approx(canvas.width)
    # Left and right of the seam.
    assert np.allclose(canvas.pixels(np.array([[-1e-9, 0, -1.0], [1e-9, 0, -1.0]]))[:, 0], [-0.5, canvas.width - 0.5])


@pytest.mark.parametrize("pitch", [90, -90])
def test_frame_with_a_pole_inside_covers_it(pitch: float) -> None:
    covered = covered_by(turned(np.zeros(1), pitch), CAMERA, SHAPE)
    assert covered.full_turn
    assert covered.b[0 if pitch > 0 else 1] == pytest.approx(-np.pi / 2 if pitch > 0 else np.pi / 2)
    canvas = canvas_around(covered, CAMERA, 2.0, "spherical")
    pole = canvas.pixels(np.array([0.0, -1.0 if pitch > 0 else 1.0, 1e-12]))
    assert pole[1] == pytest.approx(-0.5 if pitch > 0 else canvas.height - 0.5)


@pytest.mark.parametrize("name", sorted({*PROJECTIONS} - {"planar"}))
def test_rays_of_pixels_map_back_to_them(name: str) -> None:
    canvas = canvas_around(covered_by(turned(np.arange(0.0, 90, 5)), CAMERA, SHAPE), CAMERA, 1.5, name)
    (p, s), (q, r, t) = canvas.columns(), canvas.rows()
    rays = np.stack([p * r[:, None], np.repeat(q[:, None], len(p), axis=1), s * r[:, None] + t[:, None]], axis=-1)
    y, x = np.mgrid[: canvas.height, : canvas.width]
    assert np.allclose(canvas.pixels(rays), np.stack([x, y], axis=-1), atol=1e-8)


@pytest.mark.parametrize("name", sorted({*PROJECTIONS} - {"planar"}))
def test_canvas_holds_all_that_frames_cover_and_little_more(name: str) -> None:
    rotations = turned(np.arange(-60.0, 61, 5), 10)
    canvas = canvas_around(covered_by(rotations, CAMERA, SHAPE), CAMERA, 1.0, name)
    places = canvas.pixels(CAMERA.directions(outline_of(SHAPE)) @ np.swapaxes(rotations, -1, -2)).reshape(-1, 2)
    assert places.min() > -1.0
    assert (places.max(axis=0) < [canvas.width, canvas.height]).all()
    assert places[:, 0].max() - places[:, 0].min() > 0.95 * canvas.width - 3


def test_level_horizon_of_tilted_reference_frame() -> None:
    tilt = rotation_matrices([0, 0, 0.2]) @ rotation_matrices([0.3, 0, 0])
    level = turned(np.arange(-100.0, 101, 5), 10)
    horizon = level_horizon(np.linalg.inv(level[20] @ tilt) @ level)
    turned_level = horizon @ np.linalg.inv(level[20] @ tilt) @ level
    assert np.abs(turned_level[:, 1, 0]).max() < 0.01
    ahead = horizon @ [0, 0, 1]
    assert abs(ahead[0]) < 1e-9
