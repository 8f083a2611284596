"""Images as locators see them, and what is judged of a motion between two of them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Homography, Located, NotLocated, VirtualExposure
from photonpano.geometry import corners, jacobian, translation
from photonpano.locating import (
    ImageLimits,
    View,
    coarse_to_fine,
    motion_from_images,
    stabilised_8_bit,
    view_of,
    view_pyramid,
)

SHAPE = (160, 240)


def test_stabilised_8_bit_has_equal_noise_in_dark_and_bright_parts(photograph: Callable) -> None:
    """On a linear scale the ratio would be 20."""
    flux = np.full(SHAPE, 0.05)
    flux[:, 120:] = 2.0
    image, mask = stabilised_8_bit(photograph(flux), 1.0)
    assert (image.dtype, mask.dtype) == (np.uint8, np.uint8)
    assert mask.min() == 255
    dark, bright = image[:, 10:110], image[:, 130:230]
    assert bright.mean() > dark.mean() + 100
    assert 0.6 < dark.std() / bright.std() < 1.5


@pytest.mark.parametrize("halvings", [0, 1, 2])
@pytest.mark.parametrize("blur_px", [0.0, 1.0, 2.0])
def test_noise_left_predicts_variance_of_blurred_and_halved_noise(photograph: Callable, blur_px: float, halvings: int) -> None:
    view = view_of(photograph(np.full((320, 480), 0.5)), blur_px)
    for _ in range(halvings):
        view = view.halved()
    assert view.pixel == 2**halvings
    assert view.shape == (320 // view.pixel, 480 // view.pixel)
    predicted = view.noise_left * np.mean(1 / view.weight[view.seen])
    assert np.var(view.image[view.seen]) == pytest.approx(predicted, rel=0.15)


def test_view_interpolates_single_pixels_and_masks_borders(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    hot = np.zeros(SHAPE, bool)
    hot[50::20, 150::20] = True
    for unseen in (hot, np.arange(SHAPE[1]) < 100 + np.zeros((SHAPE[0], 1))):
        exposure.flux[unseen], exposure.weight[unseen] = np.nan, 0
    seen = view_of(exposure, 1.5).seen
    np.testing.assert_array_equal(np.flatnonzero(seen.any(axis=0)), np.arange(105, 235))
    np.testing.assert_array_equal(np.flatnonzero(seen.any(axis=1)), np.arange(5, 155))
    assert seen[5:155, 105:235].all()


def half_seen(exposure: VirtualExposure, rows: slice, seed: int) -> VirtualExposure:
    """Leave half of the frames of some rows, as a mask of dead rows does at half the scale."""
    counts = np.rint(-np.expm1(-exposure.flux) * exposure.weight).astype(int)
    counts[rows] = np.random.default_rng(seed).binomial(counts[rows], 0.5)
    exposure.weight[rows] /= 2
    flux = exposure.response.flux((counts / exposure.weight).astype(np.float32), exposure.weight)
    return replace(exposure, flux=flux)


@pytest.mark.parametrize("flux", [3e-4, 0.05])
def test_rows_that_a_mask_covers_in_part_do_not_stand_out_from_noise(photograph: Callable, flux: float) -> None:
    rows = slice(20, None, 10)
    view = view_of(half_seen(photograph(np.full(SHAPE, flux)), rows, seed=1), 1.0)
    inside = np.where(view.seen, view.image, np.nan)[:, 10:-10]
    excess = np.nanmean(inside[rows]) - np.nanmean(inside[15::10])
    assert abs(excess) < 0.3 * np.nanstd(inside[15::10])


STILL = np.eye(3)


@pytest.mark.parametrize("failing", [{0}, {1}, {2}, {0, 1, 2}])
def test_coarse_to_fine_skips_layers_that_fail_and_reports_the_finest(seen_from: Callable, failing: set[int]) -> None:
    views = view_pyramid(seen_from(STILL), 1.0, 3, 24)
    starts = {}

    def align(moving: View, fixed: View, start: Homography, depth: int) -> Homography | NotLocated:
        starts[depth] = start * 1.0
        return NotLocated(f"layer {depth}") if depth in failing else start @ translation(1, 0)

    found, failure = coarse_to_fine(views, views, translation(8, 0), align)
    assert len(found) == 3 - len(failing)
    assert failure == (NotLocated("layer 0") if 0 in failing else None)
    shift = 8.0
    for depth in (2, 1, 0):
        assert starts[depth][0, 2] == pytest.approx(shift / 2**depth)
        shift += 0 if depth in failing else 2**depth
    if found:
        assert found[-1][0, 2] == pytest.approx(shift)


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
