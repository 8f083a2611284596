from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from photonpano.photometry import linear_to_srgb, srgb_to_linear, tone_mapped


def f32(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float32)


def test_known_values() -> None:
    """Values of the standard: middle grey of 8 bits, and the end of the linear part."""
    np.testing.assert_allclose(srgb_to_linear(f32(0, 0.04045, 118 / 255, 1)), [0, 0.0031308, 0.18116, 1], rtol=1e-4)
    np.testing.assert_allclose(linear_to_srgb(f32(0, 0.0031308, 0.5, 1)), [0, 0.04045, 0.73536, 1], rtol=1e-4)


@given(st.floats(0, 1, width=32))
def test_srgb_to_linear_inverts_linear_to_srgb(value: float) -> None:
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(f32(value))), value, atol=1e-5)


def test_linear_to_srgb_clips_and_keeps_nan() -> None:
    np.testing.assert_allclose(linear_to_srgb(f32(-1, 2, np.nan)), f32(0, 1, np.nan), rtol=1e-6)


def test_tone_mapped_is_white_at_white_flux_and_black_at_nan() -> None:
    picture = tone_mapped(f32(0, 0.4, 0.2, 5, np.nan), white=0.4)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, [0, 255, 188, 255, 0])
