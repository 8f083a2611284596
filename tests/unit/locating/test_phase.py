from __future__ import annotations

import cv2
import numpy as np
import pytest

from photonpano.locating import View, correlation_peaks, correlation_surface, shift_between, shift_by_phase

SHAPE = (80, 120)


def noise(seed: int = 0) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SHAPE), (0, 0), 2).astype(np.float32)


@pytest.mark.parametrize("gaussian_peak", [True, False])
def test_shift_by_phase_finds_cyclic_shift(gaussian_peak: bool) -> None:
    image = noise()
    shift = shift_by_phase(image, np.roll(image, (-7, 50), axis=(0, 1)), 1.5, gaussian_peak)
    np.testing.assert_allclose(shift, [50, -7], atol=0.05)


def test_shift_between_returns_none_without_contrast_or_overlap() -> None:
    ones, left = np.ones(SHAPE, np.float32), np.broadcast_to(np.arange(SHAPE[1]) < 60, SHAPE).astype(np.float32)
    assert shift_between(View(ones, ones, 1.0), View(ones, ones, 1.0)) is None
    assert shift_between(View(noise(), left, 1.0), View(noise(), 1 - left, 1.0)) is None


def test_correlation_peaks_are_in_order_of_height_and_to_a_fraction_of_a_pixel() -> None:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    peaks = [(0.7, -20.3, 0.0), (1.0, 10.2, 5.4), (0.2, 0.0, 30.0)]
    gaussians = [
        height * np.exp(-((((x - right + 60) % 120) - 60) ** 2 + (((y - down + 40) % 80) - 40) ** 2) / 2)
        for height, right, down in peaks
    ]
    shifts, heights = correlation_peaks(sum(gaussians), 0.3)
    np.testing.assert_allclose(shifts, [[10.2, 5.4], [-20.3, 0]], atol=0.02)
    np.testing.assert_allclose(heights, [1, 0.7], rtol=0.15)


def test_correlation_surface_is_none_without_texture() -> None:
    assert correlation_surface(np.zeros((80, 61), complex), SHAPE, 1.0) is None
