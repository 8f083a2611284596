"""Tests of projections, and of canvases of a camera that turns."""

import numpy as np
import pytest

from photonpano.geometry import PROJECTIONS, Camera, canvas_around, covered_by, level_horizon, rotation_matrices

SHAPE = (40, 60)
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
