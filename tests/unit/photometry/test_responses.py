"""Responses, contrast, tone, white balance and pictures."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.photometry import (
    BinaryResponse,
    BinarySumResponse,
    IntensityResponse,
    Tone,
    balanced,
    linear_to_srgb,
    picture_of,
    signal_to_noise,
    srgb_to_linear,
    tone_mapped,
)
from photonpano.testing import photographed

RESPONSE = BinaryResponse()


def f32(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float32)


@given(st.floats(0, 6, width=32))
def test_flux_inverts_mean_count(flux: float) -> None:
    estimate = RESPONSE.flux(RESPONSE.mean_count(f32(flux)), 1e6)
    assert estimate.dtype == np.float32
    np.testing.assert_allclose(estimate, flux, rtol=1e-4, atol=1e-6)


@given(st.integers(1, 100_000))
def test_flux_of_saturated_pixel_is_that_of_half_a_dark_frame(frames: int) -> None:
    np.testing.assert_allclose(RESPONSE.flux(f32(1), frames), np.log(2 * frames), rtol=2e-3)
    # It stays the brightest: a pixel with one dark frame is dimmer.
    assert RESPONSE.flux(f32(1 - 1 / frames), frames) < RESPONSE.flux(f32(1), frames)


def test_flux_clips_means_above_1_and_keeps_nan() -> None:
    flux = RESPONSE.flux(f32(1.0000001, np.nan, -1e-9), f32(10, 10, 10))
    np.testing.assert_allclose(flux, [np.log(20), np.nan, 0], rtol=1e-6)


@pytest.mark.parametrize("frames", [100, 400])
def test_stabilised_noise_is_uniform(frames: int) -> None:
    """The standard deviation of 20,000 draws has an error of 0.5 %; the rest is that of the approximation."""
    flux = f32(0.2, 0.5, 1.0, 2.0)[:, None]
    rng = np.random.default_rng(0)
    counts = rng.binomial(frames, -np.expm1(-flux.astype(float)), (4, 20_000))
    stabilised = RESPONSE.stabilised(RESPONSE.flux((counts / frames).astype(np.float32), frames), frames)
    np.testing.assert_allclose(stabilised.std(axis=1), float(RESPONSE.stabilised_std(frames)), rtol=0.03)


def test_stabilised_mean_does_not_depend_on_number_of_frames() -> None:
    """Four counts in forty frames, on average, and 40 in 400; the means of 200,000 draws have an error of 0.0003."""
    rng = np.random.default_rng(0)
    few, many = (
        RESPONSE.stabilised(RESPONSE.flux((rng.binomial(n, 0.1, 200_000) / n).astype(np.float32), n), n).mean()
        for n in (40, 400)
    )
    assert few == pytest.approx(many, abs=0.004)
    assert np.arcsin(np.sqrt(rng.binomial(40, 0.1, 200_000) / 40)).mean() < many - 0.008


@pytest.mark.parametrize("n", [1, 15, 255])
def test_binary_sum_response_follows_binary_response(n: int) -> None:
    response, flux = BinarySumResponse(n), f32(0, 0.02 * n, 0.5 * n, 2 * n)
    rng = np.random.default_rng(n)
    sums = rng.binomial(n, -np.expm1(-flux / n), (200_000 // n, 4))
    np.testing.assert_allclose(sums.mean(axis=0), response.mean_count(flux), rtol=0.02)
    np.testing.assert_allclose(response.flux(response.mean_count(flux), 1000), flux, rtol=1e-4)
    np.testing.assert_allclose(response.flux(f32(n), 1), n * np.log(2 * n), rtol=1e-3)


GREY = IntensityResponse(photons_per_level=40.0, black_level=16.0, saturation_level=235.0, read_noise=25.0)


def test_intensity_response_is_linear_up_to_saturation() -> None:
    np.testing.assert_allclose(GREY.mean_count(f32(0, 400, 1e9, np.inf, np.nan)), [16, 26, 235, 235, np.nan])
    np.testing.assert_allclose(GREY.flux(f32(16, 26, 235, 250, np.nan), 1), [0, 400, 8760, 8760, np.nan])


@pytest.mark.parametrize("n_frames", [1, 4, 30])
@pytest.mark.parametrize("flux", [0.0, 100.0, 2000.0])
def test_intensity_response_stabilises_noise(flux: float, n_frames: int) -> None:
    """Photon noise and read noise together; the transform clips single frames with more noise than light."""
    rng = np.random.default_rng(0)
    photons = rng.poisson(flux, (n_frames, 40_000)) + rng.normal(0, GREY.read_noise, (n_frames, 40_000))
    levels = (16 + photons / GREY.photons_per_level).mean(axis=0).astype(np.float32)
    stabilised = GREY.stabilised(GREY.flux(levels, n_frames), n_frames)
    assert stabilised.dtype == np.float32
    expected = float(GREY.stabilised_std(n_frames))
    assert stabilised.std() == pytest.approx(expected, rel=0.05)
    np.testing.assert_allclose(stabilised.mean(), GREY.stabilised(f32(flux), 1e6), atol=0.05 * expected + 0.02)


def waves(amplitude: float) -> np.ndarray:
    """Flux whose arcsin(sqrt(mean count)) is a wave, much longer than the averaged blocks."""
    x = np.arange(300)[None] + np.zeros((200, 1))
    return -np.log1p(-(np.sin(np.pi / 4 + amplitude * np.sin(x / 20)) ** 2))


@pytest.mark.parametrize(("amplitude", "frames"), [(0.05, 100), (0.2, 100), (0.05, 400)])
def test_signal_to_noise_is_contrast_over_photon_noise(amplitude: float, frames: int) -> None:
    """The standard deviation of a wave is its amplitude / sqrt(2), that of the noise of n frames 1 / (2 sqrt(n))."""
    expected = amplitude / np.sqrt(2) * 2 * np.sqrt(frames)
    assert signal_to_noise(photographed(waves(amplitude), frames)) == pytest.approx(expected, rel=0.05)


def test_grey_world_makes_the_mean_grey_and_keeps_green() -> None:
    flux = np.random.default_rng(0).uniform(0, [0.2, 1.0, 0.5], (20, 30, 3)).astype(np.float32)
    flux[3] = np.nan
    means = np.nanmean(balanced(flux, "grey-world"), axis=(0, 1))
    assert means == pytest.approx(np.full(3, np.nanmean(flux[..., 1])), rel=1e-5)


def test_factors_multiply_colours_and_leave_grey_images_alone() -> None:
    flux = np.ones((2, 3, 3), np.float32)
    assert balanced(flux, (2, 1, 0.5))[0, 0].tolist() == [2, 1, 0.5]
    assert balanced(flux, "none") is flux
    grey = flux[..., 0]
    assert balanced(grey, (2, 1, 0.5)) is grey


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


@pytest.mark.parametrize("tone", [tone for tone in TONES if tone != "srgb"])
def test_picture_of_shows_details_at_both_ends(tone: Tone) -> None:
    """Of a range of 100 dB, the sRGB curve shows the bright half only."""
    bright, dark = slice(10, 40), slice(170, 200)
    picture = picture_of(night(), 1.0, tone)
    assert contrast(picture, bright) > 5
    assert contrast(picture, dark) > 2
    assert contrast(picture_of(night(), 1.0), dark) < 1


@given(st.floats(0, 1, width=32))
def test_srgb_to_linear_inverts_linear_to_srgb(value: float) -> None:
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(f32(value))), value, atol=1e-5)


def test_tone_mapped_is_white_at_white_flux_and_black_at_nan() -> None:
    picture = tone_mapped(f32(0, 0.4, 0.2, 5, np.nan), white=0.4)
    assert picture.dtype == np.uint8
    np.testing.assert_array_equal(picture, [0, 255, 188, 255, 0])
