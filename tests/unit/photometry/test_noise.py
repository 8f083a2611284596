"""Photon noise, and the similarity of exposures."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from photonpano.photometry import (
    BinaryResponse,
    BinarySumResponse,
    IntensityResponse,
    Similarity,
    autocorrelation,
    debiased,
    flux_std,
    measurable_range,
    noise_free_correlation,
    saturated,
    similarity_of,
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


@pytest.mark.parametrize("flux", [0.0, 20.0])
def test_flux_std_is_finite_and_positive_where_no_or_all_frames_are_lit(flux: float) -> None:
    found, std = estimates(flux)
    assert np.isfinite(found).all()
    assert np.isfinite(std).all()
    assert (std > 0).all()


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


N_SIMILAR = 20_000


def noisy(scene, variance, seed):
    noise = np.random.default_rng(seed).normal(0, np.sqrt(variance), len(scene))
    return (scene + noise).astype(np.float32)


def correlation(first, second, noise, independent=N_SIMILAR):
    return noise_free_correlation(np.cov(first, second), noise, independent)


@pytest.fixture(scope="module")
def scenes():
    return np.random.default_rng(0).normal(size=(2, N_SIMILAR))


@pytest.mark.parametrize("variance", [0.01, 1.0, 4.0])
def test_noise_free_correlation_is_1_for_one_scene_at_any_noise(scenes, variance):
    first, second = noisy(scenes[0], variance, 1), noisy(scenes[0], variance / 2, 2)
    # The covariance and both variances err by about this much of the scene's own variance.
    error = (1 + variance) * np.sqrt(2 / N_SIMILAR)
    assert correlation(first, second, (variance, variance / 2)) == pytest.approx(1, abs=5 * error)


def smeared(seed, down_px, across_px):
    """White noise under a Gaussian: 64 x 96 pixels, of mean 0."""
    noise = np.random.default_rng(seed).normal(size=(64, 96))
    image = gaussian_filter(noise, (down_px, across_px), mode="wrap").astype(np.float32)
    return image - image.mean()


def compared(first, second):
    covariance = np.cov(first.ravel(), second.ravel())
    return similarity_of(covariance, (0, 0), first.size, first.size, (autocorrelation(first), autocorrelation(second)))


@pytest.mark.parametrize("second", [(1, 6), (6, 1)], ids=["same blur", "crossed"])
def test_similarity_score_of_unrelated_images_has_unit_variance(second):
    """Two hundred pairs of smears: with pixels in place of structures the score would be 3 to 5 times as large."""
    scores = [compared(smeared(seed, 1, 6), smeared(1000 + seed, *second)).score for seed in range(200)]
    assert np.std(scores) == pytest.approx(1, abs=0.2)


def test_why_different_names_the_number_that_decides():
    image, few, others = smeared(0, 1, 1), smeared(0, 10, 10), smeared(1, 10, 10)
    assert compared(image, image).why_different(0.5) is None
    assert compared(image, smeared(1, 1, 1)).why_different(0.5).endswith("less than min_agreement = 0.5")
    nearly = compared(few, few + 0.6 * others)
    assert nearly.correlation > 0.7
    assert nearly.why_different(0.5).endswith("independent structures in them this may be chance")
    assert Similarity(0.0, 0.0, 0.0).why_different(0.5) == (
        "where the images overlap after alignment, nothing stands out from photon noise"
    )
