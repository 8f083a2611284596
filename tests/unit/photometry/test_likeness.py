"""The correlation that noisy images would have without their noise."""

import numpy as np
import pytest

from photonpano.photometry import noise_free_correlation

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
