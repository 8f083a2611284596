"""Photon noise, and the similarity of exposures."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from photonpano import Response
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
    without_local_mean,
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


@pytest.mark.parametrize("response", [BinarySumResponse(255), IntensityResponse(2.0, 16.0, 255.0, 1.0)], ids=["sums", "levels"])
@pytest.mark.parametrize("n_frames", [1, 2, 100, 1000])
def test_a_pixel_that_lacks_one_count_in_one_frame_is_not_saturated(response: Response, n_frames: int) -> None:
    counts = np.array([255, 255 - 1 / n_frames, 250, 30], np.float32)
    flux = response.flux(counts, np.float32(n_frames))
    found = saturated(flux, np.full(4, n_frames, np.float32), response)
    np.testing.assert_array_equal(found, [True, False, False, False])


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


def test_noise_free_correlation_is_half_for_scenes_that_share_half_of_their_amplitude(scenes):
    mixed = (scenes[0] + np.sqrt(3) * scenes[1]) / 2
    assert correlation(noisy(scenes[0], 1, 1), noisy(mixed, 1, 2), (1, 1)) == pytest.approx(0.5, abs=0.06)


def test_noise_free_correlation_is_small_for_different_scenes(scenes):
    assert abs(correlation(noisy(scenes[0], 1, 1), noisy(scenes[1], 1, 2), (1, 1))) < 0.1


def test_noise_free_correlation_is_0_for_noise_alone():
    blank = np.zeros(N_SIMILAR)
    assert correlation(noisy(blank, 1, 1), noisy(blank, 1, 2), (1, 1)) == 0


def test_noise_free_correlation_is_0_for_fewer_than_50_pixels(scenes):
    few = scenes[0, :200].astype(np.float32)
    assert correlation(few, few, (0, 0), 49) == 0
    assert correlation(few, few, (0, 0), 50) == pytest.approx(1)


def smeared(seed, down_px, across_px):
    """White noise under a Gaussian: 64 x 96 pixels, of mean 0."""
    noise = np.random.default_rng(seed).normal(size=(64, 96))
    image = gaussian_filter(noise, (down_px, across_px), mode="wrap").astype(np.float32)
    return image - image.mean()


def compared(first, second):
    covariance = np.cov(first.ravel(), second.ravel())
    return similarity_of(covariance, (0, 0), first.size, first.size, (autocorrelation(first), autocorrelation(second)))


def test_autocorrelation_of_gaussian_blur_is_a_wider_gaussian():
    found = np.mean([autocorrelation(smeared(seed, 1, 2)) for seed in range(20)], axis=0)
    assert found.shape == (2 * 16 + 1, 24 + 1)
    down, across = np.mgrid[-16:17, :25]
    np.testing.assert_allclose(found, np.exp(-(down**2) / 4 - across**2 / 16), atol=0.05)
    assert not autocorrelation(np.zeros((8, 8), np.float32)).any()


@pytest.mark.parametrize(("down_px", "across_px"), [(1, 1), (3, 1), (1, 3)])
def test_similarity_counts_as_many_structures_as_blur_leaves(down_px, across_px):
    """The squares of the autocorrelation of a Gaussian sum up to 2 pi times the product of its standard deviations."""
    images = [smeared(seed, down_px, across_px) for seed in range(20)]
    found = np.mean([compared(first, second).structures for first, second in zip(images[1:], images[:-1], strict=True)])
    assert found == pytest.approx(64 * 96 / (2 * np.pi * down_px * across_px), rel=0.15)


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


def test_without_local_mean_keeps_details_alone():
    """A ramp has no details; pixels that were not seen count in no mean and are 0."""
    ramp = np.add.outer(np.arange(40.0), 2 * np.arange(60.0)).astype(np.float32)
    seen = np.ones(ramp.shape, bool)
    inside = without_local_mean(ramp, seen)[6:-6, 6:-6]
    np.testing.assert_allclose(inside, 0, atol=1e-4)
    seen[20, 30], ramp[20, 30] = False, 1e6
    found = without_local_mean(ramp, seen)
    assert found[20, 30] == 0
    assert np.abs(found[6:-6, 6:-6]).max() < 1
