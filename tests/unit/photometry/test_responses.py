from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from photonpano.photometry import BinaryResponse, BinarySumResponse, IntensityResponse

RESPONSE = BinaryResponse()


def f32(*values: float) -> np.ndarray:
    return np.array(values, dtype=np.float32)


def test_known_values() -> None:
    np.testing.assert_allclose(RESPONSE.mean_count(f32(0, np.log(2), 3)), [0, 0.5, 1 - np.exp(-3)], rtol=1e-6)
    np.testing.assert_allclose(RESPONSE.flux(f32(0, 0.5, 0.75), 100), [0, np.log(2), np.log(4)], rtol=1e-6)


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


def test_stabilised_ranges_from_0_to_half_pi() -> None:
    np.testing.assert_allclose(RESPONSE.stabilised(f32(0, np.log(2), 100), 1e6), [0, np.pi / 4, np.pi / 2], atol=2e-3)


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


@pytest.mark.parametrize("flux", [0.05, 1.0, 20.0])
def test_binary_sum_response_stabilises_noise(flux: float) -> None:
    response, n_frames = BinarySumResponse(15), 40
    sums = np.random.default_rng(0).binomial(15 * n_frames, -np.expm1(-flux / 15), 50_000)
    estimates = response.flux((sums / n_frames).astype(np.float32), n_frames)
    values = response.stabilised(estimates, np.float32(n_frames))
    np.testing.assert_allclose(values.std(), response.stabilised_std(n_frames), rtol=0.06)
    np.testing.assert_allclose(values.mean(), response.stabilised(f32(flux), 1e9)[0], atol=0.02)


GREY = IntensityResponse(photons_per_level=40.0, black_level=16.0, saturation_level=235.0, read_noise=25.0)


def test_intensity_response_is_linear_up_to_saturation() -> None:
    np.testing.assert_allclose(GREY.mean_count(f32(0, 400, 1e9, np.inf, np.nan)), [16, 26, 235, 235, np.nan])
    np.testing.assert_allclose(GREY.flux(f32(16, 26, 235, 250, np.nan), 1), [0, 400, 8760, 8760, np.nan])


def test_intensity_response_keeps_negative_flux_below_black_level() -> None:
    np.testing.assert_allclose(GREY.flux(f32(15.5), 1), [-20])


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


def test_intensity_response_keeps_nan_of_unseen_pixels() -> None:
    assert np.isnan(GREY.stabilised(f32(np.nan), f32(0))).all()
