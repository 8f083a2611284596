"""Homographies: products, steps, and which are plausible."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from photonpano.geometry import (
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


@given(homographies, homographies, points)
def test_products_apply_right_factor_first(first: np.ndarray, second: np.ndarray, where: np.ndarray) -> None:
    together = normalised(second @ first)
    np.testing.assert_allclose(
        transform_points(together, where), transform_points(second, transform_points(first, where)), atol=1e-6
    )


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


FRAME = (254, 496)
HOMOGRAPHY = np.array([[1.02, 0.03, 11.0], [-0.02, 0.98, -4.0], [2e-5, -3e-5, 1.0]])


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


SMALL = (101, 201)


def about_centre(matrix: np.ndarray) -> np.ndarray:
    """Return a map that acts about the centre of the image."""
    return normalised(translation(100, 50) @ matrix @ translation(-100, -50))


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
