from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import Located, NotLocated
from photonpano.geometry import corner_displacements, from_parameters, inverse, transform_points, translation
from photonpano.locating import PointLimits, motion_from_points

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


def test_motion_from_points_accepts_float32_and_sizes() -> None:
    points, moved = (each.astype(np.float32) for each in matches())
    motion = motion_from_points(points, moved, NEAR, SHAPE, LIMITS, sizes=np.full(120, 4, np.float32))
    assert corner_displacements(located(motion).homography, TRUE, SHAPE).mean() < 0.2


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


@settings(deadline=None)
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
