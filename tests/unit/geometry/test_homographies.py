"""Homographies: products, steps, and which are plausible."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from photonpano import geometry, photometry
from photonpano.geometry import (
    corner_displacements,
    corners,
    from_parameters,
    generators,
    inverse,
    jacobian,
    normalised,
    parameters,
    rescaled,
    rescaling,
    slopes,
    step_motions,
    steps_of,
    transform_points,
    translation,
    unit_coordinates,
    why_implausible,
)

small = st.floats(-0.2, 0.2)
shift = st.floats(-500, 500)
perspective = st.floats(-1e-4, 1e-4)
homographies = st.builds(lambda *p: from_parameters(p), small, small, small, small, shift, shift, perspective, perspective)
points = st.lists(st.tuples(st.floats(-10, 600), st.floats(-10, 300)), min_size=1, max_size=5).map(np.array)


def test_transform_points_divides_by_depth() -> None:
    tilted = np.array([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.001, 0.0, 1.0]])
    np.testing.assert_allclose(transform_points(tilted, [[100, 50], [0, 0]]), [[105 / 1.1, 50 / 1.1], [5, 0]])


def test_step_motions_shift_roll_and_zoom_about_centre_of_frame() -> None:
    shifted, rolled, zoomed = step_motions([[1, 2, 0, 0], [0, 0, np.pi / 2, 0], [0, 0, 0, 0.5]], (11, 21))
    np.testing.assert_allclose(shifted, translation(1, 2))
    np.testing.assert_allclose(transform_points(rolled, [[10, 5], [14, 5]]), [[10, 5], [10, 9]], atol=1e-12)
    np.testing.assert_allclose(transform_points(zoomed, [[10, 5], [14, 7]]), [[10, 5], [16, 8]], atol=1e-12)
    steps = [[1, -2, 0.3, 0.2], [0, 0, -0.1, -0.4]]
    np.testing.assert_allclose(steps_of(step_motions(steps, (11, 21)), (11, 21)), steps, atol=1e-12)


def test_transform_points_takes_x_as_column_and_y_as_row() -> None:
    image = np.zeros((5, 7), np.float32)
    image[1, 2] = 1
    moved = cv2.warpPerspective(image, translation(3, 1), (7, 5))
    x, y = transform_points(translation(3, 1), [[2, 1]])[0]
    assert (x, y) == (5, 2)
    assert moved[int(y), int(x)] == 1


def test_transform_points_returns_infinity_on_the_horizon_without_warning() -> None:
    horizon = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])
    assert np.isinf(transform_points(horizon, [[100, 50]])).all()


def test_transform_points_maps_stacks_with_shared_or_own_points() -> None:
    stack = np.stack([translation(1, 0), translation(0, 2)])
    np.testing.assert_array_equal(transform_points(stack, [[5, 5]]), [[[6, 5]], [[5, 7]]])
    np.testing.assert_array_equal(transform_points(stack, [[[5, 5]], [[0, 0]]]), [[[6, 5]], [[0, 2]]])


@given(homographies, points)
def test_inverse_maps_points_back(homography: np.ndarray, where: np.ndarray) -> None:
    np.testing.assert_allclose(transform_points(inverse(homography), transform_points(homography, where)), where, atol=1e-6)
    assert inverse(homography)[2, 2] == 1


@given(homographies, homographies, points)
def test_products_apply_right_factor_first(first: np.ndarray, second: np.ndarray, where: np.ndarray) -> None:
    together = normalised(second @ first)
    np.testing.assert_allclose(
        transform_points(together, where), transform_points(second, transform_points(first, where)), atol=1e-6
    )


@pytest.mark.parametrize("bad", [np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)])
def test_normalised_refuses_matrix_without_h33(bad: np.ndarray) -> None:
    with pytest.raises(ValueError, match="a homography must be finite and have h33 other than 0"):
        normalised(bad)


def test_rescaling_keeps_pixel_edges_in_place() -> None:
    """The edges of the image lie at -0.5; the first pixel of a half-size image covers the first two."""
    np.testing.assert_allclose(transform_points(rescaling(0.5), [[-0.5, -0.5], [0.5, 0.5]]), [[-0.5, -0.5], [0, 0]])
    np.testing.assert_allclose(transform_points(rescaling(2), [[0, 0], [7.5, 3.5]]), [[0.5, 0.5], [15.5, 7.5]])


@pytest.mark.parametrize("scale", [0.5, 2.0, 3.0])
def test_rescaling_agrees_with_opencv(scale: float) -> None:
    ramp = np.tile(np.arange(24, dtype=np.float32), (12, 1))
    resized = cv2.resize(ramp, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
    inside = resized[5, int(scale) : -int(scale) or None]
    columns = np.arange(len(resized[5]))[int(scale) : -int(scale) or None]
    back = transform_points(inverse(rescaling(scale)), np.stack([columns, np.full(len(columns), 5)], axis=1))[:, 0]
    np.testing.assert_allclose(inside, back, atol=1e-5)


@given(homographies, points, st.sampled_from([0.25, 0.5, 2.0, 3.0]))
def test_rescaled_is_the_same_motion_of_rescaled_points(homography: np.ndarray, where: np.ndarray, scale: float) -> None:
    to_scaled = rescaling(scale)
    expected = transform_points(to_scaled, transform_points(homography, where))
    np.testing.assert_allclose(
        transform_points(rescaled(homography, scale), transform_points(to_scaled, where)), expected, atol=1e-6
    )


def test_parameters_are_ordered_as_in_the_paper() -> None:
    p = np.arange(1, 9) / 10
    expected = [[1 + p[0], p[2], p[4]], [p[1], 1 + p[3], p[5]], [p[6], p[7], 1]]
    np.testing.assert_allclose(from_parameters(p), expected)
    np.testing.assert_array_equal(from_parameters(np.zeros((2, 8))), np.stack([np.eye(3)] * 2))


@given(st.lists(homographies, min_size=1, max_size=4).map(np.stack))
def test_from_parameters_inverts_parameters(stack: np.ndarray) -> None:
    assert parameters(stack).shape == (len(stack), 8)
    np.testing.assert_allclose(from_parameters(parameters(stack)), stack, rtol=0, atol=1e-12)


@given(homographies, points)
def test_jacobian_agrees_with_finite_differences(homography: np.ndarray, where: np.ndarray) -> None:
    p = parameters(homography)
    steps = np.diag([1e-6] * 4 + [1e-4] * 2 + [1e-9] * 2)
    differences = [
        (transform_points(from_parameters(p + step), where) - transform_points(from_parameters(p - step), where))
        / (2 * step.max())
        for step in steps
    ]
    derivatives = jacobian(homography, where)
    assert derivatives.shape == (len(where), 2, 8)
    # The derivatives by p7 and p8 grow with the square of the coordinates.
    np.testing.assert_allclose(derivatives, np.stack(differences, axis=-1), rtol=1e-4, atol=1e-2)


def test_old_names_stay() -> None:
    assert geometry.apply is transform_points
    assert photometry.tapered is photometry.hann_window


def test_corners_are_pixel_centres_clockwise() -> None:
    np.testing.assert_array_equal(corners((3, 5)), [[0, 0], [4, 0], [4, 2], [0, 2]])


def test_corner_displacements_are_distances() -> None:
    stack = np.stack([np.eye(3), translation(3, 4)])
    np.testing.assert_allclose(corner_displacements(stack, np.eye(3), (3, 5)), [[0] * 4, [5] * 4])


FRAME = (254, 496)
HOMOGRAPHY = np.array([[1.02, 0.03, 11.0], [-0.02, 0.98, -4.0], [2e-5, -3e-5, 1.0]])


def test_unit_coordinates_span_the_longer_side():
    edges = np.array([[-0.5, 126.5], [495.5, 126.5], [247.5, 126.5]])
    assert transform_points(unit_coordinates(FRAME), edges) == pytest.approx(np.array([[-1, 0], [1, 0], [0, 0]]))


def test_generators_are_derivatives_of_pixel_homographies():
    unit = unit_coordinates(FRAME)
    step = 1e-6 * np.arange(1, 9)
    changed = np.linalg.inv(unit) @ from_parameters(step) @ unit
    assert np.eye(3) + np.tensordot(step, generators(FRAME), 1) == pytest.approx(changed, rel=1e-12, abs=1e-12)


def test_slopes_agree_with_finite_differences():
    points = corners(FRAME)
    rows = np.concatenate([points, np.ones((4, 1))], axis=1).T
    found = slopes(HOMOGRAPHY @ rows, HOMOGRAPHY @ generators(FRAME) @ rows)
    for parameter in range(8):
        step = np.zeros(8)
        step[parameter] = 1e-6
        moved = (np.eye(3) + sign * np.tensordot(step, generators(FRAME), 1) for sign in (1, -1))
        ahead, behind = (transform_points(HOMOGRAPHY @ each, points) for each in moved)
        assert found[:, parameter] == pytest.approx(((ahead - behind) / 2e-6).ravel(), rel=1e-6, abs=1e-4)


def test_slopes_of_stack_equal_slopes_of_each():
    rows = np.concatenate([corners(FRAME), np.ones((4, 1))], axis=1).T
    both = np.stack([HOMOGRAPHY, np.eye(3)])
    found = slopes(both @ rows, both[:, None] @ generators(FRAME) @ rows)
    assert found.shape == (2, 8, 8)
    for homography, of_it in zip(both, found, strict=True):
        assert of_it == pytest.approx(slopes(homography @ rows, homography @ generators(FRAME) @ rows))


SMALL = (101, 201)


def about_centre(matrix: np.ndarray) -> np.ndarray:
    """Return a map that acts about the centre of the image."""
    return normalised(translation(100, 50) @ matrix @ translation(-100, -50))


def turned(degrees: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    "homography",
    [np.eye(3), translation(170, 0), translation(-90, 40), about_centre(turned(40)), about_centre(np.diag([1.3, 1.3, 1.0]))],
    ids=["identity", "shift", "diagonal shift", "roll", "zoom"],
)
def test_why_implausible_accepts_camera_motion(homography: np.ndarray) -> None:
    assert why_implausible(homography, SMALL) is None


TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0025, 0.0, 1.0]])
TILTED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.005, 1.0]])

REASONS = [
    (np.full((3, 3), np.nan), "the homography is not finite"),
    (np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]]), "the homography sends part of the image behind the camera"),
    (about_centre(np.diag([-1.0, 1.0, 1.0])), "the homography mirrors or folds the image"),
    (np.diag([0.0, 1.0, 1.0]), "the homography mirrors or folds the image"),
    (
        about_centre(np.diag([2.0, 2.0, 1.0])),
        "the homography changes the area of the image by a factor of 4 (at most 2 is plausible)",
    ),
    (
        about_centre(rescaling(0.6)),
        "the homography changes the area of the image by a factor of 0.36 (at most 2 is plausible)",
    ),
    (
        about_centre(TURNED),
        "the homography makes opposite sides of the image differ by a factor of 1.7 (at most 1.5 is plausible)",
    ),
    (
        about_centre(TILTED),
        "the homography makes opposite sides of the image differ by a factor of 1.7 (at most 1.5 is plausible)",
    ),
    (translation(190, 0), "the images overlap by 5% (at least 10% is needed)"),
    (translation(1000, 0), "the images overlap by 0% (at least 10% is needed)"),
]


@pytest.mark.parametrize(("homography", "reason"), REASONS)
def test_why_implausible_gives_reason(homography: np.ndarray, reason: str) -> None:
    assert why_implausible(homography, SMALL) == reason


@pytest.mark.parametrize("px", [1e-10, 1e-6, 1e-3])
def test_frames_that_hardly_move_overlap(px: float) -> None:
    """OpenCV's intersection of polygons with nearly equal corners was empty, or a half."""
    shifts = np.random.default_rng(0).choice([0, px], (200, 2))
    assert {why_implausible(translation(*shift), SMALL, min_overlap=0.99) for shift in shifts.tolist()} == {None}
    tilted = [np.array([[1, 0, 0], [0, 1, 0], [0, tilt, 1]]) for tilt in (px * 1e-2, -px * 1e-2)]
    assert {why_implausible(each, SMALL, min_overlap=0.98) for each in tilted} == {None}


@given(
    st.builds(
        lambda *p: about_centre(from_parameters(p)),
        *[st.floats(-0.15, 0.15)] * 4,
        st.floats(-150, 150),
        st.floats(-80, 80),
        *[st.floats(-5e-4, 5e-4)] * 2,
    )
)
def test_why_implausible_overlap_agrees_with_warped_mask(homography: np.ndarray) -> None:
    assume(why_implausible(homography, SMALL, min_overlap=0) is None)
    height, width = SMALL
    quad = cv2.perspectiveTransform(corners(SMALL)[None], homography)[0]
    mask = np.zeros((16 * (height - 1), 16 * (width - 1)), np.uint8)  # sixteen times as fine
    cv2.fillConvexPoly(mask, np.rint(16 * quad - 0.5).astype(np.int32), 1)
    share = float(mask.mean())
    assume(share > 0.03)
    assert why_implausible(homography, SMALL, min_overlap=share - 0.02) is None
    reason = why_implausible(homography, SMALL, min_overlap=share + 0.02)
    assert reason is not None
    assert reason.startswith("the images overlap by ")
