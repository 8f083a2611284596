from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from photonpano_opencv.viewing import blur_against_noise, stabilised_8_bit

if TYPE_CHECKING:
    from collections.abc import Callable

SHAPE = (160, 240)


def test_noise_is_as_strong_in_the_dark_as_in_the_light(photograph: Callable) -> None:
    """On a linear scale it would be twenty times as strong."""
    flux = np.full(SHAPE, 0.05)
    flux[:, 120:] = 2.0
    image, mask = stabilised_8_bit(photograph(flux), 1.0)
    assert (image.dtype, mask.dtype) == (np.uint8, np.uint8)
    assert mask.min() == 255
    dark, bright = image[:, 10:110], image[:, 130:230]
    assert bright.mean() > dark.mean() + 100
    assert 0.6 < dark.std() / bright.std() < 1.5


def test_single_hot_pixels_do_not_flatten_the_rest(photograph: Callable) -> None:
    flux = np.full(SHAPE, 0.2)
    flux[:, ::2] = 0.3
    calm = stabilised_8_bit(photograph(flux), 0)[0].std()
    flux.flat[:: SHAPE[0] * SHAPE[1] // 20] = 6
    assert stabilised_8_bit(photograph(flux), 0)[0].std() > 0.8 * calm


def test_nothing_leaks_in_from_where_nothing_was_seen(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    exposure.flux[:, :100], exposure.weight[:, :100] = np.nan, 0
    exposure.flux[:, 100:] = 0.5
    exposure.flux[:, 200:] = 0.6
    image, mask = stabilised_8_bit(exposure, 2.0)
    np.testing.assert_array_equal(mask, np.where(np.arange(240) < 100, 0, 255) * np.ones((160, 1)))
    # The border of what was seen is as the rest of it.
    assert np.ptp(image[:, 100:190]) <= 1


def test_an_exposure_that_saw_nothing_is_black(photograph: Callable) -> None:
    exposure = photograph(np.full(SHAPE, 0.5))
    exposure.flux[:], exposure.weight[:] = np.nan, 0
    image, mask = stabilised_8_bit(exposure, 1.0)
    assert not image.any()
    assert not mask.any()


def test_the_dark_is_blurred_more(seen_from: Callable) -> None:
    blurs = [blur_against_noise(seen_from(np.eye(3), 0, brightness)) for brightness in (1.0, 0.1, 0.02, 0.0)]
    assert blurs == sorted(blurs)
    assert (blurs[0], blurs[-1]) == pytest.approx((1.0, 2.5))
