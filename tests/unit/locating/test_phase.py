"""Phase correlation, and which part of an image follows a motion."""

import cv2
import numpy as np
import pytest

from photonpano.locating import Follows, correlation_peaks, follows, shift_of_spectra

SHAPE = (80, 120)


def noise(seed: int = 0) -> np.ndarray:
    return cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SHAPE), (0, 0), 2).astype(np.float32)


@pytest.mark.parametrize("gaussian_peak", [True, False])
def test_shift_of_spectra_finds_cyclic_shift(gaussian_peak: bool) -> None:
    spectra = (np.fft.rfft2(image) for image in (noise(), np.roll(noise(), (-7, 50), axis=(0, 1))))
    shift = shift_of_spectra(*spectra, SHAPE, 1.5, gaussian_peak=gaussian_peak)
    np.testing.assert_allclose(shift, [50, -7], atol=0.05)


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


FRAME = (60, 90)
NOISE = 0.01


def texture(seed: int) -> np.ndarray:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, FRAME), (0, 0), 2)
    return (noise / noise.std()).astype(np.float32)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    return image + np.random.default_rng(seed).normal(0, np.sqrt(NOISE / 2), FRAME).astype(np.float32)


@pytest.fixture
def with_a_square() -> Follows:
    """Images that are the same but for the square of rows 20 to 39 and columns 30 to 59."""
    scene, other = texture(1), texture(1)
    other[20:40, 30:60] = texture(2)[20:40, 30:60]
    return follows(noisy(scene, 3), noisy(other, 4), np.full(FRAME, NOISE, np.float32))


def test_part_that_differs_is_left_out_with_a_border(with_a_square: Follows) -> None:
    assert with_a_square.suspect
    assert not with_a_square.part[24:36, 34:56].any()
    assert with_a_square.part[:12].all()
    assert not with_a_square.inner[20:40, 30:60].any()
    assert with_a_square.inner[:10].all()


def test_nothing_is_told_where_nothing_stands_out_from_noise() -> None:
    flat = np.zeros(FRAME, np.float32)
    part = follows(noisy(flat, 3), noisy(flat, 4), np.full(FRAME, NOISE, np.float32))
    assert np.isnan(part.difference).mean() > 0.99
    assert not part.suspect
    assert part.part.mean() > 0.99


def test_larger_part_counts_more_unless_the_other_motion_is_trusted(with_a_square: Follows) -> None:
    inside = np.ones(FRAME, np.float32)
    inside[20:40, 30:60] = 0
    square = Follows(inside)
    assert with_a_square.more_than(square)
    assert not square.more_than(with_a_square)
    assert square.more_than(with_a_square, trust=1e3)
