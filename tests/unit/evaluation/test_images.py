from __future__ import annotations

import numpy as np
import pytest

from photonpano.evaluation import covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, rescaling, translation
from photonpano.photometry import srgb_to_linear

WHITE = 2.5


def flux_of(encoded: np.ndarray) -> np.ndarray:
    """Return the flux that is `encoded` in sRGB when images are compared."""
    return srgb_to_linear(encoded) * np.float32(WHITE)


@pytest.fixture
def encoded() -> np.ndarray:
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    return 0.5 + 0.25 * np.sin(x / 5) * np.cos(y / 4)


def test_image_score_of_equal_images_is_perfect(encoded):
    score = image_score(flux_of(encoded), flux_of(encoded), np.ones(encoded.shape, bool), WHITE)
    assert score.psnr_db == np.inf
    assert score.ssim == pytest.approx(1)
    assert score.compared_share == 1


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_image_score_psnr_is_that_of_added_noise(encoded, sigma):
    noise = np.random.default_rng(0).normal(0, sigma, encoded.shape)
    score = image_score(flux_of(encoded + noise), flux_of(encoded), np.ones(encoded.shape, bool), WHITE)
    # The variance of 19,200 independent differences has an error of 1 %, which is 0.045 dB.
    assert score.psnr_db == pytest.approx(-20 * np.log10(sigma), abs=0.15)


def test_image_score_ssim_of_flat_noisy_image_follows_formula():
    sigma = 0.05
    flat = np.full((200, 200), 0.5)
    noise = np.random.default_rng(0).normal(0, sigma, flat.shape)
    score = image_score(flux_of(flat + noise), flux_of(flat), np.ones(flat.shape, bool), WHITE)
    # Without structure the index is c2 / (c2 + v) for the variance v inside a window. The weights of a Gaussian of
    # sigma 1.5 sum up to 1 with squares of w2 = 1 / (4 pi 1.5^2): the mean takes a share w2 of the variance,
    # and v scatters by v sqrt(2 w2), which bends the mean of the index upwards.
    c2, w2 = 0.03**2, 1 / (4 * np.pi * 1.5**2)
    v = sigma**2 * (1 - w2)
    assert score.ssim == pytest.approx(c2 / (c2 + v) * (1 + (v / (c2 + v)) ** 2 * 2 * w2), rel=0.01)


def test_image_score_ignores_pixels_that_are_not_compared(encoded):
    compared = np.zeros(encoded.shape, bool)
    compared[20:100, 30:130] = True
    panorama = flux_of(np.where(compared, encoded, 0.9))
    score = image_score(panorama, flux_of(encoded), compared, WHITE)
    assert score.psnr_db == np.inf
    assert score.ssim == pytest.approx(1)
    assert score.compared_share == pytest.approx(80 * 100 / encoded.size)


def test_image_score_ignores_nan_of_either_image(encoded):
    panorama, truth = flux_of(encoded), flux_of(encoded)
    panorama[:30] = np.nan
    truth[:, -40:] = np.nan
    score = image_score(panorama, truth, np.ones(encoded.shape, bool), WHITE)
    assert score.psnr_db == np.inf
    assert score.compared_share == pytest.approx(90 * 120 / encoded.size)


def test_image_score_ssim_is_nan_without_whole_window(encoded):
    compared = np.zeros(encoded.shape, bool)
    compared[40:50, :] = True
    score = image_score(flux_of(encoded), flux_of(encoded), compared, WHITE)
    assert np.isnan(score.ssim)
    assert score.psnr_db == np.inf


def test_image_score_ssim_is_nan_for_image_smaller_than_window():
    tiny = flux_of(np.full((8, 9), 0.5))
    assert np.isnan(image_score(tiny, tiny, np.ones((8, 9), bool), WHITE).ssim)


def test_image_score_clips_at_white(encoded):
    truth = flux_of(encoded)
    truth[50:60, 50:60] = WHITE
    panorama = truth.copy()
    panorama[50:60, 50:60] = 10 * WHITE
    assert image_score(panorama, truth, np.ones(encoded.shape, bool), WHITE).psnr_db == np.inf


def test_image_score_refuses_empty_comparison(encoded):
    with pytest.raises(ValueError, match="no pixel is compared"):
        image_score(flux_of(encoded), flux_of(encoded), np.zeros(encoded.shape, bool), WHITE)
    with pytest.raises(ValueError, match="white must be a positive flux"):
        image_score(flux_of(encoded), flux_of(encoded), np.ones(encoded.shape, bool), 0)


def test_covered_is_false_for_hardly_seen_pixels():
    weight = np.full((10, 10), 400, dtype=np.float32)
    weight[0], weight[1], weight[2] = 0, 19, 20
    np.testing.assert_array_equal(covered(weight).all(axis=1), [False, False, *[True] * 8])
    assert not covered(np.zeros((3, 3), dtype=np.float32)).any()


def test_white_flux_ignores_a_lamp():
    scene = np.linspace(0, 1, 10_000, dtype=np.float32).reshape(100, 100)
    scene[0, :5] = 1000
    assert white_flux(scene) == pytest.approx(0.999, abs=2e-3)


def test_true_panorama_samples_scene_through_canvas_and_alignment():
    x, y = np.meshgrid(np.arange(50, dtype=np.float32), np.arange(40, dtype=np.float32))
    scene = 2 * x + 3 * y  # linear interpolation is exact on a plane
    reference_to_scene = translation(5.5, 4)
    reference_to_canvas = rescaling(2.0) @ translation(3, 1)
    image = true_panorama(scene, Canvas(300, 90, reference_to_canvas), reference_to_scene)
    assert image.shape == (300, 90)
    # Canvas (20, 10) is reference ((20.5 / 2 - 0.5) - 3, (10.5 / 2 - 0.5) - 1) = (6.75, 3.75), and scene (12.25, 7.75).
    assert image[10, 20] == pytest.approx(2 * 12.25 + 3 * 7.75, rel=1e-6)
    assert np.isnan(image[299]).all()


def test_true_panorama_of_a_finer_scene_averages_the_area_of_each_pixel():
    """A scene with four pixels a side of a pixel of the canvas: stripes of two px vanish, and means stay in their places."""
    scene = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    image = true_panorama(scene, Canvas(12, 16, np.eye(3)), rescaling(4))
    np.testing.assert_allclose(image[:-1, :-1], scene.reshape(12, 4, 16, 4).mean(axis=(1, 3))[:-1, :-1], rtol=1e-5)


def test_true_panorama_at_the_resolution_of_the_scene_is_the_scene():
    """A panorama of scale 2 of a scene with two pixels a side of a pixel of a frame."""
    scene = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    image = true_panorama(scene, Canvas(48, 64, rescaling(2)), rescaling(2))
    np.testing.assert_allclose(image, scene, rtol=1e-5)
