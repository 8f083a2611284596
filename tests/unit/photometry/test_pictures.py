from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from photonpano.photometry import Tone, picture_of, tone_mapped

TONES = get_args(Tone)


def night(colours: int = 0) -> np.ndarray:
    """Stripes of 1 to 3 on light that falls by 100 dB from left to right; a corner is unknown."""
    x = np.arange(240)
    stripes = np.where(x // 6 % 2, 3.0, 1.0) * 10 ** (-5 * x / 240)
    flux = np.tile(stripes, (60, 1)).astype(np.float32)
    flux[:5, :5] = np.nan
    return flux if not colours else np.repeat(flux[..., None], colours, axis=-1)


def contrast(picture: np.ndarray, columns: slice) -> float:
    """Standard deviation of the levels of a part."""
    return float(picture[30, columns].astype(float).std())


def test_picture_of_srgb_has_bytes_of_tone_mapped() -> None:
    np.testing.assert_array_equal(picture_of(night(), 1.5), tone_mapped(night(), 1.5))


@pytest.mark.parametrize("tone", TONES)
@pytest.mark.parametrize("colours", [0, 3])
def test_picture_of_keeps_shape_and_shows_unknown_pixels_black(tone: Tone, colours: int) -> None:
    picture = picture_of(night(colours), 1.0, tone)
    assert (picture.shape, picture.dtype) == (night(colours).shape, np.uint8)
    assert (picture[:5, :5] == 0).all()
    assert picture.max() == 255


@pytest.mark.parametrize("tone", [tone for tone in TONES if tone != "srgb"])
def test_picture_of_shows_details_at_both_ends(tone: Tone) -> None:
    """Of a range of 100 dB, the sRGB curve shows the bright half only."""
    bright, dark = slice(10, 40), slice(170, 200)
    picture = picture_of(night(), 1.0, tone)
    assert contrast(picture, bright) > 5
    assert contrast(picture, dark) > 2
    assert contrast(picture_of(night(), 1.0), dark) < 1


@pytest.mark.parametrize("tone", TONES)
def test_picture_of_grows_brighter_by_stops(tone: Tone) -> None:
    levels = [int(picture_of(night(), 1.0, tone, stops)[30, 100:140].sum()) for stops in (-1.0, 0.0, 1.0)]
    assert levels == sorted(levels)
    assert levels[0] < levels[2]


@pytest.mark.parametrize("tone", TONES)
@pytest.mark.parametrize("level", [0.0, 0.3, np.nan])
def test_picture_of_even_image_is_finite(tone: Tone, level: float) -> None:
    picture = picture_of(np.full((40, 50), level, np.float32), 1.0, tone)
    assert picture.shape == (40, 50)
    assert (picture > 0).all() == (level > 0)
