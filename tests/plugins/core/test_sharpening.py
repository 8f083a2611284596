from __future__ import annotations

import cv2
import numpy as np
import pytest

from photonpano.merging import PhotonSum
from photonpano.testing import MemorySource
from photonpano_core.mergers.dense_motion.frames import count_variance, sharpened

SHAPE, N = (96, 128), 5000
RESPONSE = MemorySource(np.zeros((1, 4, 4), np.uint8)).response
EVERYWHERE = np.ones(SHAPE, bool)


def texture() -> np.ndarray:
    """Probability of a photon, with detail of a few pixels."""
    noise = np.random.default_rng(0).standard_normal(SHAPE)
    return 0.35 + 0.25 * np.tanh(2 * cv2.GaussianBlur(noise, (0, 0), 1.0))


def interpolated(mean: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Sums of photons of N frames, shifted by fractions of a pixel and linearly interpolated back."""
    rng, parts = np.random.default_rng(1), len(fractions)
    total = np.zeros(SHAPE, np.float32)
    rows, columns = np.indices(SHAPE, np.float32)
    for x, y in fractions.astype(np.float32):
        there = cv2.remap(mean.astype(np.float32), columns - x, rows - y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        counts = rng.binomial(N // parts, np.clip(there, 0, 1)).astype(np.float32)
        total += cv2.remap(counts, columns + x, rows + y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return total


FRACTIONS = np.random.default_rng(2).uniform(0, 1, (50, 2))
BLUR = np.full(SHAPE, (FRACTIONS * (1 - FRACTIONS)).mean(), np.float32)


def errors(mean: np.ndarray, counts: np.ndarray, blur: np.ndarray = BLUR) -> tuple[float, float]:
    """Mean squared errors before and after."""
    weight = np.full(SHAPE, N, np.float32)
    found = sharpened(PhotonSum(counts, weight), blur, EVERYWHERE, RESPONSE)
    inside = (slice(4, -4), slice(4, -4))
    before, after = (float(np.mean((each / weight - mean)[inside] ** 2)) for each in (counts, found.counts))
    return before, after


def test_blur_of_interpolation_is_undone() -> None:
    before, after = errors(texture(), interpolated(texture(), FRACTIONS))
    assert after < 0.6 * before


def test_photon_noise_of_a_plain_surface_is_not_amplified() -> None:
    plain = np.full(SHAPE, 0.3)
    before, after = errors(plain, interpolated(plain, FRACTIONS))
    assert after < 1.05 * before


def test_what_was_not_interpolated_is_not_sharpened() -> None:
    counts = interpolated(texture(), np.zeros((1, 2)))
    weight = np.full(SHAPE, N, np.float32)
    found = sharpened(PhotonSum(counts, weight), np.zeros(SHAPE, np.float32), EVERYWHERE, RESPONSE)
    np.testing.assert_allclose(found.counts, counts, rtol=1e-5)


def test_pixels_beside_unseen_ones_and_outside_are_kept() -> None:
    counts, weight = interpolated(texture(), FRACTIONS), np.full(SHAPE, N, np.float32)
    counts[40, 50] = weight[40, 50] = 0
    where = EVERYWHERE.copy()
    where[:20] = False
    found = sharpened(PhotonSum(counts, weight), BLUR, where, RESPONSE).counts
    np.testing.assert_array_equal(found[39:42, 49:52], counts[39:42, 49:52])
    np.testing.assert_array_equal(found[:20], counts[:20])
    assert (found[60:80] != counts[60:80]).any()


def test_variance_of_binary_counts_is_that_of_a_coin() -> None:
    mean = np.linspace(0.05, 0.8, 16, dtype=np.float32)
    assert count_variance(mean, RESPONSE) == pytest.approx(mean * (1 - mean), rel=0.03)
