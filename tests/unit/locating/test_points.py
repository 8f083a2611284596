"""Homographies of matched points: limits, fits, and the part of them that is a turn."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano import Located, NotLocated
from photonpano.geometry import (
    Camera,
    corner_displacements,
    corners,
    from_parameters,
    inverse,
    jacobian,
    parameters,
    rotation_matrices,
    scaled_ahead,
    transform_points,
    translation,
)
from photonpano.locating import PointLimits, information_on_turn, motion_from_points, turn_slopes
from photonpano.locating.points import fit_homography

SHAPE = (160, 240)
TRUE = from_parameters([0.03, -0.02, 0.01, -0.04, 12, 9, 1e-4, -5e-5])
NEAR = translation(0.6, -0.4) @ TRUE
LIMITS = PointLimits()


def matches(count: int = 120, wrong: int = 0, std_px: float = 0.3, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points that move by TRUE with errors of 0.3 px; the first `wrong` of them are outliers."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), (239, 159), (count, 2))
    moved = transform_points(TRUE, points) + rng.normal(0, std_px, points.shape)
    moved[:wrong] += rng.uniform(20, 60, (wrong, 2))
    return points, moved


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def lost(motion: Located | NotLocated) -> NotLocated:
    assert isinstance(motion, NotLocated)
    return motion


def test_motion_from_points_fits_inliers_and_counts_outliers() -> None:
    motion = located(motion_from_points(*matches(wrong=30), NEAR, SHAPE, LIMITS, evidence={"keypoints": 400.0}))
    assert corner_displacements(motion.homography, TRUE, SHAPE).mean() < 0.2
    assert corner_displacements(motion.homography, inverse(TRUE), SHAPE).mean() > 10
    assert motion.residual_px == pytest.approx(0.3, rel=0.25)
    assert motion.evidence == {"keypoints": 400, "matches": 120, "inliers": 90}


def test_second_round_adds_inliers_that_initial_motion_missed() -> None:
    start = translation(1.8, 0) @ TRUE
    once, twice = (located(motion_from_points(*matches(), start, SHAPE, LIMITS, rounds=rounds)) for rounds in (1, 2))
    assert once.evidence["inliers"] < 90
    assert twice.evidence["inliers"] == 120


def test_too_few_inliers_are_rejected_with_their_number() -> None:
    failure = lost(motion_from_points(*matches(40, wrong=29), NEAR, SHAPE, LIMITS))
    assert failure.reason == "11 of 40 matches lie within 2 px of the motion, fewer than min_inliers = 12"
    assert failure.evidence == {"matches": 40, "inliers": 11}


def test_clustered_points_are_rejected_for_uncertain_corners() -> None:
    points, moved = matches(40)
    near = np.linalg.norm(points - points.mean(axis=0), axis=1) < 60
    failure = lost(motion_from_points(points[near], moved[near], TRUE, SHAPE, PointLimits(max_std_px=0.5)))
    assert failure.reason.startswith(f"{near.sum()} inliers leave the corners of the frame uncertain by ")
    assert failure.reason.endswith(" px, more than max_std_px = 0.5")


@pytest.mark.parametrize(
    ("start", "reason"),
    [
        (np.diag([0.5, 0.5, 1]), "the homography changes the area of the image by a factor of 0.25 (at most 2 is plausible)"),
        (np.full((3, 3), np.nan), "the homography is not finite"),
    ],
    ids=["shrinks", "nan"],
)
def test_implausible_initial_motion_is_rejected(start: np.ndarray, reason: str) -> None:
    assert lost(motion_from_points(*matches(), start, SHAPE, LIMITS)).reason == f"{reason}, from 120 matches"


@given(count=st.integers(0, 30), seed=st.integers(0, 2**32 - 1), degenerate=st.booleans())
def test_motion_from_points_never_raises(count: int, seed: int, degenerate: bool) -> None:
    """Also for coincident points; the information of a located pair is positive definite."""
    points, moved = matches(count, seed=seed)
    if degenerate:
        points[:], moved[:] = points[:1], moved[:1]
    motion = motion_from_points(points, moved, TRUE, SHAPE, LIMITS)
    if degenerate or count < LIMITS.min_inliers:
        lost(motion)
    elif isinstance(motion, Located):
        np.linalg.cholesky(motion.information)


SIZES = np.full(120, 4, np.float32)


def fine_matches(seed: int, std_px: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), (239, 159), (len(SIZES), 2))
    return points.astype(np.float32), (transform_points(TRUE, points) + rng.normal(size=points.shape) * std_px).astype(
        np.float32
    )


def mean_error_px(homography: np.ndarray) -> float:
    return float(corner_displacements(homography, TRUE, SHAPE).mean())


def test_information_predicts_scatter_of_100_fits() -> None:
    """With errors of 0.3 px: chi squared of eight parameters has the mean 8."""
    chi_squared = []
    for seed in range(100):
        fit = fit_homography(*fine_matches(seed, 0.3), SIZES, TRUE)
        error = parameters(fit.homography) - parameters(TRUE)
        chi_squared.append(error @ fit.information @ error)
    assert np.mean(chi_squared) == pytest.approx(8, rel=0.2)


def test_rounding_px_keeps_common_error_in_information() -> None:
    """Over 100 fits to fine_matches with a common error of about 0.3 px and little scatter."""
    chi_squared = []
    for seed in range(100):
        here, there = fine_matches(seed, 0.05)
        there += np.random.default_rng(seed).normal(0, 0.3, 2)
        fit = fit_homography(here, there, SIZES, TRUE, rounding_px=0.3)
        error = parameters(fit.homography) - parameters(TRUE)
        chi_squared.append(error @ fit.information @ error)
    assert np.mean(chi_squared) == pytest.approx(8, rel=0.2)


def test_fit_is_robust_against_a_quarter_of_outliers() -> None:
    here, there = fine_matches(0, 0.3)
    clean = fit_homography(here, there, SIZES, TRUE)
    there[:30] += np.random.default_rng(1).uniform(-4, 4, (30, 2)).astype(np.float32)
    wrong = fit_homography(here, there, SIZES, TRUE)
    assert mean_error_px(wrong.homography) < 2.5 * mean_error_px(clean.homography) + 0.05
    # The outliers are unknown, so the residual is larger.
    assert 2 * clean.residual_px < wrong.residual_px < 1.5


def test_weights_by_keypoint_size_lower_the_error() -> None:
    """For position errors proportional to the sizes."""
    sizes = np.tile(np.float32([2, 20]), 60)
    errors = []
    for weighted in (sizes, SIZES):
        fits = [fit_homography(*fine_matches(seed, 0.05 * sizes[:, None]), weighted, TRUE) for seed in range(10)]
        errors.append(np.mean([mean_error_px(fit.homography) for fit in fits]))
    assert errors[0] < 0.6 * errors[1]


def test_corner_std_px_predicts_scatter_of_corners() -> None:
    fit = fit_homography(*fine_matches(0, 0.3), SIZES, TRUE)
    errors = [
        corner_displacements(fit_homography(*fine_matches(seed, 0.3), SIZES, TRUE).homography, TRUE, SHAPE)
        for seed in range(50)
    ]
    worst = np.sqrt(np.mean(np.square(errors), axis=0)).max()
    assert fit.corner_std_px(SHAPE) == pytest.approx(worst, rel=0.4)


CAMERA = Camera.of(300.0, SHAPE)
TURN = rotation_matrices([0.05, -0.2, 0.1])


def homography_of(vector: np.ndarray) -> np.ndarray:
    """Return the homography of `TURN`, after a small rotation."""
    return scaled_ahead(CAMERA.homographies(TURN @ rotation_matrices(vector)))


def test_turn_slopes_are_derivatives_of_parameters() -> None:
    step = 1e-6
    expected = [
        (parameters(homography_of(step * axis)) - parameters(homography_of(-step * axis))) / (2 * step) for axis in np.eye(3)
    ]
    np.testing.assert_allclose(
        turn_slopes(homography_of(np.zeros(3)), CAMERA.matrix), np.transpose(expected), rtol=1e-6, atol=1e-9
    )


def test_information_on_turn_is_that_of_the_likeliest_turn() -> None:
    # Estimates of all eight parameters scatter with the inverse of the information; the turn that fits each best scatters as
    # the restricted information says.
    rng = np.random.default_rng(0)
    true = homography_of(np.zeros(3))
    to_corners = jacobian(true, corners(SHAPE)).reshape(8, 8)
    root = rng.normal(size=(8, 8)) @ to_corners
    information, slopes = root.T @ root, turn_slopes(true, CAMERA.matrix)
    found, std_px = information_on_turn(information, true, CAMERA.matrix, SHAPE)
    errors = np.linalg.solve(root, rng.normal(size=(8, 4000)))
    vectors = np.linalg.solve(slopes.T @ information @ slopes, slopes.T @ information @ errors)
    moved = to_corners @ slopes @ vectors
    assert std_px == pytest.approx(np.sqrt((moved**2).sum(axis=0).mean() / 4), rel=0.03)
    # Whitened by the restricted information, the three numbers of the turn have variance 1, and nothing else is known.
    along = np.einsum("in,ij,jn->n", slopes @ vectors, found, slopes @ vectors)
    assert along.mean() == pytest.approx(3, rel=0.05)
    assert np.linalg.matrix_rank(found, tol=1e-3 * np.linalg.norm(information, 2), hermitian=True) <= 3
    stds = np.sqrt(np.linalg.eigvalsh(to_corners @ np.linalg.inv(found) @ to_corners.T))
    assert (stds[-5:] > 0.9 * max(SHAPE)).all()
