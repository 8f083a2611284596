"""The correlation that noisy images would have without their noise."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from photonpano.photometry import Likeness, autocorrelation, likeness_of, noise_free_correlation

N = 20_000


def noisy(scene, variance, seed):
    noise = np.random.default_rng(seed).normal(0, np.sqrt(variance), len(scene))
    return (scene + noise).astype(np.float32)


@pytest.fixture(scope="module")
def scenes():
    return np.random.default_rng(0).normal(size=(2, N))


@pytest.mark.parametrize("variance", [0.01, 1.0, 4.0])
def test_one_scene_correlates_fully_however_noisy_it_is(scenes, variance):
    first, second = noisy(scenes[0], variance, 1), noisy(scenes[0], variance / 2, 2)
    # The covariance and both variances err by about this much of the scene's own variance.
    error = (1 + variance) * np.sqrt(2 / N)
    assert noise_free_correlation(first, second, (variance, variance / 2), N) == pytest.approx(1, abs=5 * error)


def test_scenes_that_share_half_of_their_variance_correlate_by_half(scenes):
    mixed = (scenes[0] + np.sqrt(3) * scenes[1]) / 2
    found = noise_free_correlation(noisy(scenes[0], 1, 1), noisy(mixed, 1, 2), (1, 1), N)
    assert found == pytest.approx(0.5, abs=0.06)


def test_different_scenes_do_not_correlate(scenes):
    found = noise_free_correlation(noisy(scenes[0], 1, 1), noisy(scenes[1], 1, 2), (1, 1), N)
    assert abs(found) < 0.1


def test_noise_alone_counts_as_nothing_alike():
    blank = np.zeros(N)
    assert noise_free_correlation(noisy(blank, 1, 1), noisy(blank, 1, 2), (1, 1), N) == 0


def test_few_pixels_count_as_nothing_alike(scenes):
    few = scenes[0, :200].astype(np.float32)
    assert noise_free_correlation(few, few, (0, 0), 49) == 0
    assert noise_free_correlation(few, few, (0, 0), 50) == pytest.approx(1)


def smeared(seed, down_px, across_px):
    """White noise under a Gaussian: 64 x 96 pixels, of mean 0."""
    noise = np.random.default_rng(seed).normal(size=(64, 96))
    image = gaussian_filter(noise, (down_px, across_px), mode="wrap").astype(np.float32)
    return image - image.mean()


def compared(first, second):
    covariance = np.cov(first.ravel(), second.ravel())
    return likeness_of(covariance, (0, 0), first.size, first.size, (autocorrelation(first), autocorrelation(second)))


def test_the_autocorrelation_of_a_blur_is_a_wider_one():
    found = np.mean([autocorrelation(smeared(seed, 1, 2)) for seed in range(20)], axis=0)
    assert found.shape == (2 * 16 + 1, 24 + 1)
    down, across = np.mgrid[-16:17, :25]
    np.testing.assert_allclose(found, np.exp(-(down**2) / 4 - across**2 / 16), atol=0.05)
    assert not autocorrelation(np.zeros((8, 8), np.float32)).any()


@pytest.mark.parametrize(("down_px", "across_px"), [(1, 1), (3, 1), (1, 3)])
def test_a_blur_leaves_as_many_structures_as_its_area_allows(down_px, across_px):
    """The squares of its autocorrelation sum up to 2 pi times its standard deviations."""
    images = [smeared(seed, down_px, across_px) for seed in range(20)]
    found = np.mean([compared(first, second).structures for first, second in zip(images[1:], images[:-1], strict=True)])
    assert found == pytest.approx(64 * 96 / (2 * np.pi * down_px * across_px), rel=0.15)


@pytest.mark.parametrize("second", [(1, 6), (6, 1)], ids=["alike", "crossed"])
def test_the_score_of_different_scenes_is_that_of_chance(second):
    """Two hundred pairs of smears: with pixels in place of structures it would be 3 to 5 times as large."""
    scores = [compared(smeared(seed, 1, 6), smeared(1000 + seed, *second)).score for seed in range(200)]
    assert np.std(scores) == pytest.approx(1, abs=0.2)


def test_it_says_what_is_wrong():
    image, few, others = smeared(0, 1, 1), smeared(0, 10, 10), smeared(1, 10, 10)
    assert compared(image, image).objection(0.5) is None
    assert compared(image, smeared(1, 1, 1)).objection(0.5).endswith("less than min_agreement = 0.5")
    nearly = compared(few, few + 0.6 * others)
    assert nearly.correlation > 0.7
    assert nearly.objection(0.5).endswith("independent structures, and so few may agree by chance")
    assert Likeness(0.0, 0.0, 0.0).objection(0.5) == (
        "where the images overlap after alignment, nothing stands out from photon noise"
    )
