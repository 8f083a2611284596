"""Similarity of two noisy images: correlation without noise, and significance against chance."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from photonpano.photometry import Similarity, autocorrelation, noise_free_correlation, similarity_of, without_local_mean

N = 20_000


def noisy(scene, variance, seed):
    noise = np.random.default_rng(seed).normal(0, np.sqrt(variance), len(scene))
    return (scene + noise).astype(np.float32)


def correlation(first, second, noise, independent=N):
    return noise_free_correlation(np.cov(first, second), noise, independent)


@pytest.fixture(scope="module")
def scenes():
    return np.random.default_rng(0).normal(size=(2, N))


@pytest.mark.parametrize("variance", [0.01, 1.0, 4.0])
def test_noise_free_correlation_is_1_for_one_scene_at_any_noise(scenes, variance):
    first, second = noisy(scenes[0], variance, 1), noisy(scenes[0], variance / 2, 2)
    # The covariance and both variances err by about this much of the scene's own variance.
    error = (1 + variance) * np.sqrt(2 / N)
    assert correlation(first, second, (variance, variance / 2)) == pytest.approx(1, abs=5 * error)


def test_noise_free_correlation_is_half_for_scenes_that_share_half_of_their_amplitude(scenes):
    mixed = (scenes[0] + np.sqrt(3) * scenes[1]) / 2
    assert correlation(noisy(scenes[0], 1, 1), noisy(mixed, 1, 2), (1, 1)) == pytest.approx(0.5, abs=0.06)


def test_noise_free_correlation_is_small_for_different_scenes(scenes):
    assert abs(correlation(noisy(scenes[0], 1, 1), noisy(scenes[1], 1, 2), (1, 1))) < 0.1


def test_noise_free_correlation_is_0_for_noise_alone():
    blank = np.zeros(N)
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
