from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano.geometry import translation
from photonpano.locating import blur_against_noise, stabilised_8_bit, view_of

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


def test_stabilised_8_bit_clips_single_hot_pixels(photograph: Callable) -> None:
    flux = np.full(SHAPE, 0.2)
    flux[:, ::2] = 0.3
    calm = stabilised_8_bit(photograph(flux), 0)[0].std()
    flux.flat[:: SHAPE[0] * SHAPE[1] // 20] = 6
    assert stabilised_8_bit(photograph(flux), 0)[0].std() > 0.8 * calm


def test_stabilised_8_bit_is_not_biased_by_masked_pixels(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    exposure.flux[:, :100], exposure.weight[:, :100] = np.nan, 0
    exposure.flux[:, 100:] = 0.5
    exposure.flux[:, 200:] = 0.6
    image, mask = stabilised_8_bit(exposure, 2.0)
    np.testing.assert_array_equal(mask, np.where(np.arange(240) < 100, 0, 255) * np.ones((160, 1)))
    # The border of what was seen is as the rest of it.
    assert np.ptp(image[:, 100:190]) <= 1


def test_stabilised_8_bit_of_masked_exposure_is_black(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    exposure.flux[:], exposure.weight[:] = np.nan, 0
    image, mask = stabilised_8_bit(exposure, 1.0)
    assert not image.any()
    assert not mask.any()


def test_blur_against_noise_grows_in_the_dark(seen_from: Callable) -> None:
    blurs = [blur_against_noise(seen_from(np.eye(3), 0, brightness)) for brightness in (1.0, 0.1, 0.02, 0.0)]
    assert blurs == sorted(blurs)
    assert (blurs[0], blurs[-1]) == pytest.approx((1.0, 2.5))


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


def test_view_of_masked_exposure_is_masked(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    exposure.flux[:], exposure.weight[:] = np.nan, 0
    view = view_of(exposure, 1.0)
    assert not view.seen.any()
    assert not view.image.any()


def test_seen_from_warps_image_and_mask(seen_from: Callable) -> None:
    """By a whole number of pixels, so that nothing is interpolated."""
    view = view_of(seen_from(np.eye(3)), 1.0)
    there = view.seen_from(translation(30, -10))
    np.testing.assert_allclose(there.image[10:, :210], view.image[:150, 30:], atol=1e-6)
    np.testing.assert_array_equal(there.seen[10:, :210], view.seen[:150, 30:])
    assert not there.seen[:10].any()
    assert not there.seen[:, 210:].any()
