from __future__ import annotations

import numpy as np
import pytest

from photonpano.photometry import (
    BinaryResponse,
    BinarySumResponse,
    IntensityResponse,
    debiased,
    flux_std,
    measurable_range,
    saturated,
)

N = 10_000
PIXELS = 20_000


def estimates(flux: float, dark: float = 0.0, frames: int = N) -> tuple[np.ndarray, np.ndarray]:
    """Flux and its standard deviation of many pixels, of which sums are corrected for dark counts."""
    lit = np.random.default_rng(0).binomial(frames, -np.expm1(-flux - dark), PIXELS)
    slope, offset = np.exp(dark), -np.expm1(dark)
    mean = np.maximum(lit / frames * slope + offset, 0).astype(np.float32)
    weight = np.full(PIXELS, frames, np.float32)
    found = debiased(BinaryResponse().flux(mean, weight), weight, BinaryResponse())
    return found, flux_std(found, weight, BinaryResponse(), slope, offset)


def bound(flux: float, dark: float = 0.0, frames: int = N) -> float:
    return float(np.sqrt(np.expm1(flux + dark) / frames))


@pytest.mark.parametrize("dark", [0.0, 0.05])
@pytest.mark.parametrize("flux", [1e-3, 0.1, 1.0, 5.0, 7.0])
def test_flux_reaches_bound_from_dark_to_saturation(flux: float, dark: float) -> None:
    """Ten photons at one end, nine dark frames at the other; the means of 20,000 pixels have an error of 0.007 of the bound."""
    found, std = estimates(flux, dark)
    expected = bound(flux, dark)
    # Negative sums, which only dark counts cause, count as no light.
    assert abs(found.mean() - flux) < (0.03 if flux > expected else 0.25) * expected
    assert np.sqrt(((found - flux) ** 2).mean()) < 1.1 * expected
    assert np.median(std) == pytest.approx(expected, rel=0.1)
    assert (np.abs(found - flux) <= 2 * std).mean() > 0.935


@pytest.mark.parametrize("dark_frames", [2.0, 5.0, 20.0])
def test_flux_is_unbiased_where_few_frames_are_dark(dark_frames: float) -> None:
    """The maximum-likelihood estimate is too high by 27, 26 and 12 % of the bound."""
    flux = -np.log(dark_frames / N)
    found, _ = estimates(flux)
    assert abs(found.mean() - flux) < 0.06 * bound(flux)


def test_debiased_flux_of_k_counts_has_half_a_dark_frame_more() -> None:
    lit = np.array([0, 1, 5_000, N - 3, N, np.nan], np.float32)
    for response in (BinaryResponse(), BinarySumResponse(10)):
        n = getattr(response, "n", 1)
        flux = debiased(response.flux(lit / N * n, np.float32(N / n)), np.full(6, N / n, np.float32), response)
        np.testing.assert_allclose(flux / n, -np.log((N - lit.astype(float) + 0.5) / (N + 0.5)), rtol=1e-3)


def test_debiased_flux_of_grey_levels_is_the_flux() -> None:
    flux = np.array([-3.0, 100.0], np.float32)
    response = IntensityResponse(photons_per_level=40.0, black_level=16.0, saturation_level=235.0, read_noise=25.0)
    assert debiased(flux, np.ones(2, np.float32), response) is flux


@pytest.mark.parametrize("flux", [0.0, 20.0])
def test_flux_std_is_finite_and_positive_where_no_or_all_frames_are_lit(flux: float) -> None:
    found, std = estimates(flux)
    assert np.isfinite(found).all()
    assert np.isfinite(std).all()
    assert (std > 0).all()


def test_flux_std_keeps_nan_and_shape() -> None:
    flux = np.full((2, 3, 3), np.nan, np.float32)
    flux[0] = 0.5
    std = flux_std(flux, np.full(flux.shape, 100, np.float32), BinaryResponse())
    assert (std.shape, std.dtype) == (flux.shape, np.float32)
    np.testing.assert_array_equal(np.isnan(std), np.isnan(flux))


def test_flux_std_of_sums_is_that_of_their_binary_frames() -> None:
    flux, weight = np.array([0.1, 15.0, 60.0], np.float32), np.full(3, 50, np.float32)
    expected = 15 * flux_std(flux / 15, 15 * weight, BinaryResponse())
    np.testing.assert_allclose(flux_std(flux, weight, BinarySumResponse(15)), expected, rtol=1e-6)


@pytest.mark.parametrize("flux", [0.0, 500.0])
def test_flux_std_of_grey_levels_has_photon_and_read_noise(flux: float) -> None:
    response = IntensityResponse(photons_per_level=40.0, black_level=16.0, saturation_level=235.0, read_noise=25.0)
    rng = np.random.default_rng(0)
    photons = rng.poisson(flux, (30, PIXELS)) + rng.normal(0, 25, (30, PIXELS))
    found = response.flux((16 + photons / 40).mean(axis=0).astype(np.float32), 30)
    std = flux_std(np.full(1, flux, np.float32), np.full(1, 30, np.float32), response)
    assert float(found.std()) == pytest.approx(float(std[0]), rel=0.02)


@pytest.mark.parametrize("flux", [0.01, 0.5, 4.0])
def test_flux_std_of_unknown_response_follows_from_stabilised_scale(flux: float) -> None:
    class Foreign:
        mean_count, flux = BinaryResponse().mean_count, BinaryResponse().flux
        stabilised, stabilised_std = BinaryResponse().stabilised, BinaryResponse().stabilised_std

    std = flux_std(np.full(1, flux, np.float32), np.full(1, N, np.float32), Foreign())
    assert float(std[0]) == pytest.approx(bound(flux), rel=0.03)


def test_saturated_finds_pixels_lit_in_every_frame() -> None:
    lit = np.array([N, N - 1, N // 2, np.nan], np.float32)
    weight = np.array([N, N, N, 0], np.float32)
    flux = debiased(BinaryResponse().flux(lit / N, np.float32(N)), weight, BinaryResponse())
    np.testing.assert_array_equal(saturated(flux, weight, BinaryResponse()), [True, False, False, False])


@pytest.mark.parametrize(
    ("frames", "dark", "decibels"),
    [(10_000, 0.0, 99.9), (100_000, 0.0, 121.7), (10_000, 0.0013, 87.6), (100_000, 0.0013, 100.2)],
)
def test_measurable_range_ends_at_noise_and_at_saturation(frames: int, dark: float, decibels: float) -> None:
    found = measurable_range(frames, BinaryResponse(), np.exp(dark), -np.expm1(dark))
    assert found is not None
    assert found.decibels == pytest.approx(decibels, abs=0.1)
    assert found.high == pytest.approx(np.log(2 * frames), rel=1e-3)
    assert found.low == pytest.approx(bound(found.low, dark, frames), rel=0.02)


def test_measurable_range_through_a_vignette_is_as_without() -> None:
    """Its correction is a line around the mean count, which at low flux promises photons that there are not."""
    found, plain = measurable_range(N, BinaryResponse(), 1.2, 0.04), measurable_range(N, BinaryResponse())
    assert found is not None
    assert plain is not None
    assert found.decibels == pytest.approx(plain.decibels, abs=5)
