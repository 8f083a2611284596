from __future__ import annotations

import cv2
import numpy as np
import pytest

from photonpano.locating import View, shift_between, shift_by_phase

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
