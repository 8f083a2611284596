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


def test_directions_of_principal_point_look_ahead() -> None:
    np.testing.assert_allclose(Camera.of(300.0, (254, 496), LENS).directions([247.5, 126.5]), [0, 0, 1], atol=1e-12)


def test_homographies_of_rotations_have_determinant_1_at_any_angle() -> None:
    camera = Camera.of(330.0, (254, 496))
    rotations = rotation_matrices([[0, 0.5, 0], [0, np.pi / 2, 0], [0.1, 3.0, 0]])
    homographies = camera.homographies(rotations)
    np.testing.assert_allclose(np.linalg.det(homographies), 1)
    np.testing.assert_allclose(camera.rotations(-2 * homographies), rotations, atol=1e-12)


def test_scaled_camera_sees_the_same_directions() -> None:
    camera, point = Camera.of(300.0, (254, 496), LENS), np.array([13.0, 40.0])
    np.testing.assert_allclose(camera.scaled(0.5).directions((point + 0.5) * 0.5 - 0.5), camera.directions(point), atol=1e-12)


def test_rotation_vectors_invert_rotation_matrices() -> None:
    vectors = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose(rotation_vectors(rotation_matrices(vectors)), vectors, atol=1e-12)


def test_pixels_that_a_lens_images_only_from_the_other_side_have_no_ideal_place() -> None:
    """With this lens, nothing inside the fold is imaged beyond 11.1 focal lengths; outside, opposite places are."""
    camera = Camera.of(8.0, (128, 192), (-0.0012, 0, 0, 0))
    rays = np.array([[11.0, 0.0], [11.3, 0.0], [-14.0, 0.0], [9.0, 9.0]])
    found = camera.ideal(rays * 8 + camera.matrix[:2, 2])
    np.testing.assert_array_equal(np.isnan(found).any(axis=1), [False, True, True, True])


def test_nearest_rotations_ignores_scale_and_small_errors() -> None:
    rotations = rotation_matrices(np.random.default_rng(0).normal(size=(5, 3)))
    np.testing.assert_allclose(nearest_rotations(3 * rotations), rotations, atol=1e-12)


def test_likely_rotations_move_a_frame_by_the_whole_of_a_shift() -> None:
    """The nearest matrices that rotate would move it by half: a shift is no rotation of a plane, and the half is between."""
    camera, frame = Camera.of(4464.0, (254, 496)), corners((254, 496))
    [rotation] = likely_rotations(camera, translation(3.0, -1.0)[None], (254, 496))
    moved = transform_points(camera.homographies(rotation), frame) - frame
    np.testing.assert_allclose(moved, np.broadcast_to([3.0, -1.0], moved.shape), atol=0.03)


def test_likely_rotations_of_a_camera_that_looks_backwards_are_the_nearest() -> None:
    camera, rotations = Camera.of(330.0, (254, 496)), rotation_matrices([[0.1, 3.0, 0.0], [0.0, 0.2, 0.0]])
    found = likely_rotations(camera, camera.homographies(rotations), (254, 496))
    np.testing.assert_allclose(found, rotations, atol=1e-9)


SHAPE = (40, 60)
small = st.floats(-0.2, 0.2)
shift = st.floats(-300, 300)
perspective = st.floats(-1e-3, 1e-3)
homographies = st.builds(lambda *p: from_parameters(p), small, small, small, small, shift, shift, perspective, perspective)
motions = st.lists(homographies, min_size=1, max_size=4).map(np.stack)
scales = st.floats(0.05, 16)


def test_canvas_of_frames_spans_them() -> None:
    canvas = canvas_of(np.eye(3)[None], SHAPE, 1.0)
    assert canvas.shape == SHAPE
    np.testing.assert_array_equal(canvas.transform, np.eye(3))
    canvas = canvas_of(np.stack([translation(-7, 0), translation(5.5, 2)]), SHAPE, 1.0)
    assert (canvas.width, canvas.height) == (60 + 7 + 6, 40 + 2)
    np.testing.assert_array_equal(canvas.transform, translation(7, 0))


def test_canvas_at_twice_the_scale_has_twice_the_rows_and_columns() -> None:
    canvas = canvas_of(translation(-7, 0)[None], SHAPE, 2.0)
    assert canvas.shape == (80, 120)
    # The first reference pixel covers the first two pixels of the canvas.
    np.testing.assert_allclose(transform_points(canvas.transform, [[-7, 0]]), [[0.5, 0.5]])


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


def test_canvas_of_frame_at_the_horizon_raises() -> None:
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.02, 0.0, 1.0]])
    with pytest.raises(ValueError, match=r"^homography 1 of 2 sends part of its frame behind the reference plane$"):
        canvas_of(np.stack([np.eye(3), behind]), SHAPE, 1.0)


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


def test_half_a_turn_covers_its_angle_and_the_frame() -> None:
    covered = covered_by(turned(np.arange(0.0, 181, 5)), CAMERA, SHAPE)
    half = np.arctan2(29.5, 50)
    assert np.allclose(covered.a, (-half, np.pi + half), atol=1e-3)
    assert np.allclose(covered.b, (-np.arctan2(19.5, 50), np.arctan2(19.5, 50)), atol=1e-3)
    assert not covered.full_turn


def test_arc_across_the_seam_is_contiguous() -> None:
    covered = covered_by(turned(np.arange(100.0, 261, 5)), CAMERA, SHAPE)
    assert covered.a[1] - covered.a[0] == pytest.approx(np.radians(160) + 2 * np.arctan2(29.5, 50), abs=1e-3)


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


def test_pixel_in_the_middle_is_as_large_as_one_of_the_reference_frame() -> None:
    canvas = canvas_around(covered_by(turned(np.zeros(1)), CAMERA, SHAPE), CAMERA, 2.0, "cylindrical")
    apart = np.diff(canvas.pixels(CAMERA.directions([[29.5, 19.5], [30.5, 19.5]])), axis=0)
    assert np.allclose(apart, [[2, 0]], atol=1e-3)


def test_rays_of_pixels_map_back_to_them() -> None:
    canvas = canvas_around(covered_by(turned(np.arange(0.0, 90, 5)), CAMERA, SHAPE), CAMERA, 1.5, "spherical")
    (p, s), (q, r) = canvas.columns(), canvas.rows()
    rays = np.stack([p * r[:, None], np.repeat(q[:, None], len(p), axis=1), s * r[:, None]], axis=-1)
    y, x = np.mgrid[: canvas.height, : canvas.width]
    assert np.allclose(canvas.pixels(rays), np.stack([x, y], axis=-1), atol=1e-8)


def test_level_horizon_of_tilted_reference_frame() -> None:
    tilt = rotation_matrices([0, 0, 0.2]) @ rotation_matrices([0.3, 0, 0])
    level = turned(np.arange(-100.0, 101, 5), 10)
    horizon = level_horizon(np.linalg.inv(level[20] @ tilt) @ level)
    turned_level = horizon @ np.linalg.inv(level[20] @ tilt) @ level
    assert np.abs(turned_level[:, 1, 0]).max() < 0.01
    ahead = horizon @ [0, 0, 1]
    assert abs(ahead[0]) < 1e-9


def test_camera_that_hardly_turns_stays_level() -> None:
    horizon = level_horizon(turned(np.arange(0.0, 2, 0.1)))
    assert np.allclose(horizon, np.eye(3), atol=1e-6)


def test_arc_that_reaches_over_the_end_of_the_circle_covers_its_beginning() -> None:
    """A frame that looks up covers a wide arc, which ends beyond that of the frame beside it."""
    wide = turned(np.zeros(1), 60)
    covered = covered_by(np.concatenate([wide, turned(np.array([40.0]))]), CAMERA, SHAPE)
    assert np.allclose(covered.a, covered_by(wide, CAMERA, SHAPE).a)
