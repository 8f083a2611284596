from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import corners, from_parameters, inverse, jacobian, translation
from photonpano.locating import ImageLimits, View, motion_from_images, view_of

SHAPE = (160, 240)
STILL = np.eye(3)
SHIFT = translation(9, -4)
LIMITS = ImageLimits()
BLUR_PX = 1.0


def judged(moving: VirtualExposure, fixed: VirtualExposure, homography: np.ndarray, **options: object) -> Located | NotLocated:
    return motion_from_images(view_of(moving, BLUR_PX), view_of(fixed, BLUR_PX), homography, LIMITS, **options)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def corner_std_px(motion: Located) -> float:
    """Return the expected error of a corner, from the information."""
    to_corners = jacobian(motion.homography, corners(SHAPE)).reshape(8, 8)
    return float(np.sqrt(np.trace(to_corners @ np.linalg.inv(motion.information) @ to_corners.T) / 4))


@pytest.mark.parametrize("brightness", [1.0, 0.1])
def test_true_motion_is_accepted_with_evidence(seen_from: Callable, brightness: float) -> None:
    moving, fixed = seen_from(SHIFT, 1, brightness), seen_from(STILL, 2, brightness)
    motion = located(judged(moving, fixed, SHIFT, evidence={"steps": 7.0}))
    assert motion.homography is SHIFT
    assert motion.evidence["steps"] == 7
    assert motion.evidence["similarity"] > 0.9
    assert motion.evidence["noise_ratio"] == pytest.approx(1, abs=0.15)
    assert motion.evidence["overlap"] == pytest.approx((1 - 15 / 240) * (1 - 10 / 160), abs=0.02)
    assert motion.residual_px == pytest.approx(corner_std_px(motion))


def gauss_newton(moving: View, fixed: View) -> np.ndarray:
    """Return the shift relative to SHIFT by least squares, an efficient estimator."""
    there = fixed.seen_from(SHIFT)
    inside = (slice(12, -12), slice(12, -12))
    y, x = np.gradient((moving.image + there.image) / 2)
    j = np.stack([x[inside].ravel(), y[inside].ravel()], axis=1)
    return -np.linalg.lstsq(j, (there.image - moving.image)[inside].ravel(), rcond=None)[0]


@pytest.mark.parametrize("brightness", [1.0, 0.2])
def test_information_predicts_scatter_of_least_squares_shifts(seen_from: Callable, brightness: float) -> None:
    """Over 30 pairs, against the information on p5 and p6 with the other parameters held."""
    errors, predicted = [], []
    for seed in range(30):
        moving, fixed = (view_of(seen_from(each, 2 * seed + i, brightness), BLUR_PX) for i, each in enumerate((SHIFT, STILL)))
        motion = located(motion_from_images(moving, fixed, SHIFT, LIMITS))
        errors.append(np.sum(gauss_newton(moving, fixed) ** 2))
        predicted.append(np.trace(np.linalg.inv(motion.information[4:6, 4:6])))
    assert np.sqrt(np.mean(errors) / np.mean(predicted)) == pytest.approx(1, abs=0.35)


def test_parameters_not_estimated_get_weak_prior(seen_from: Callable) -> None:
    moving, fixed = seen_from(SHIFT, 1), seen_from(STILL, 2)
    every = located(judged(moving, fixed, SHIFT))
    shift = located(judged(moving, fixed, SHIFT, free=(4, 5)))
    np.linalg.cholesky(shift.information)
    assert shift.residual_px < every.residual_px < 0.2
    # Corners lie 145 px from the middle; three hundredths of that in each of six parameters.
    assert 3 < corner_std_px(shift) < 15
    # In the midst of its texture it is known far better.
    at = np.stack(np.meshgrid(np.linspace(0, 239, 25), np.linspace(0, 159, 17)), axis=-1).reshape(-1, 2)
    j = jacobian(SHIFT, at)
    std_px = np.sqrt(np.trace(j @ np.linalg.inv(shift.information) @ j.transpose(0, 2, 1), axis1=1, axis2=2))
    assert std_px.min() < 0.2 * corner_std_px(shift)


def test_misalignment_lowers_information(seen_from: Callable) -> None:
    moving, fixed = seen_from(SHIFT, 1), seen_from(STILL, 2)
    exact, off = (located(judged(moving, fixed, each)) for each in (SHIFT, translation(1, 0) @ SHIFT))
    assert off.evidence["noise_ratio"] > 3 * exact.evidence["noise_ratio"]
    assert corner_std_px(off) > 1.5 * corner_std_px(exact)


@pytest.mark.parametrize("brightness", [1.0, 0.1])
def test_pair_of_different_places_is_rejected_for_similarity(seen_from: Callable, brightness: float) -> None:
    failure = judged(seen_from(translation(0, 330), 1, brightness), seen_from(STILL, 2, brightness), STILL)
    assert isinstance(failure, NotLocated)
    similarity = failure.evidence["similarity"]
    assert failure.reason == f"after alignment the similarity of the images is {similarity:.2f}, less than min_agreement = 0.5"


def test_pair_of_noise_is_rejected(photograph: Callable) -> None:
    walls = (photograph(np.full(SHAPE, 0.5), seed) for seed in (1, 2))
    failure = judged(*walls, STILL)
    assert isinstance(failure, NotLocated)
    assert failure.reason == "where the images overlap after alignment, nothing stands out from photon noise"


def masked(exposure: VirtualExposure, seen: np.ndarray) -> VirtualExposure:
    return replace(
        exposure, flux=np.where(seen, exposure.flux, np.float32(np.nan)), weight=np.where(seen, exposure.weight, np.float32(0))
    )


def test_too_little_overlap_is_rejected_with_its_share(seen_from: Callable) -> None:
    left = np.arange(SHAPE[1]) < 125 + np.zeros((SHAPE[0], 1))
    moving, fixed = masked(seen_from(STILL, 1), left), masked(seen_from(STILL, 2), ~left)
    assert judged(moving, fixed, STILL) == NotLocated(
        "after alignment both exposures see 0% of the image, less than min_overlap = 10%", {"overlap": 0.0}
    )
    assert judged(moving, fixed, translation(235, 0)) == NotLocated("the images overlap by 2% (at least 10% is needed)")


def test_implausible_motion_is_rejected(seen_from: Callable) -> None:
    exposure = seen_from(STILL)
    assert judged(exposure, exposure, np.diag([-1.0, 1, 1])).reason == "the homography mirrors or folds the image"


def test_uncertain_corners_are_rejected(seen_from: Callable) -> None:
    moving, fixed = (view_of(seen_from(STILL, seed, 0.1), BLUR_PX) for seed in (1, 2))
    failure = motion_from_images(moving, fixed, STILL, ImageLimits(max_std_px=0.01))
    assert isinstance(failure, NotLocated)
    assert "the images leave the corners uncertain by 0." in failure.reason
    assert failure.reason.endswith("px, more than max_std_px = 0.01")


def test_pair_and_its_inverse_have_equal_corner_errors(seen_from: Callable) -> None:
    """So the information is that of the parameters of the homography, in its direction."""
    true = from_parameters([0.01, 0.004, -0.006, 0.02, 9.0, 4.0, 2e-5, -3e-5])
    moving, fixed = seen_from(true, 1), seen_from(STILL, 2)
    there, back = located(judged(moving, fixed, true)), located(judged(fixed, moving, inverse(true)))
    assert corner_std_px(there) == pytest.approx(corner_std_px(back), rel=0.2)
