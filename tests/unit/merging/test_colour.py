"""Images in colour, made of the images of single colours."""

import numpy as np
import pytest

from photonpano.merging.colour import filled, with_clear, with_shared_detail
from photonpano.photometry import BinaryResponse

SHAPE = (64, 80)
FRAMES = 2000


def scene() -> np.ndarray:
    """Fine texture in two colours: (H, W, 3)."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    brightness = 0.3 + 0.15 * np.sin(x / 1.7) * np.sin(y / 2.3)
    tint = np.where(x[..., None] < 40, (0.8, 0.5, 0.2), (0.2, 0.6, 0.9))
    return (brightness[..., None] * tint).astype(np.float32)


def seen_by(flux: np.ndarray, weight: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return the flux that binary frames show, NaN where none was taken."""
    counts = np.random.default_rng(seed).binomial(weight.astype(int), -np.expm1(-flux))
    mean = counts / np.maximum(weight, 1)
    return np.where(weight > 0, BinaryResponse().flux(mean.astype(np.float32), np.maximum(weight, 1)), np.float32(np.nan))


def test_colours_that_motion_brings_everywhere_stay_as_they_are() -> None:
    weight = np.broadcast_to(np.float32([500, 1000, 500]), (*SHAPE, 3))
    flux = seen_by(scene(), weight)
    np.testing.assert_array_equal(filled(flux, weight), flux)


def test_filling_follows_the_texture_of_the_colours_that_were_seen() -> None:
    """A part of the image lacks red and blue."""
    weight = np.full((*SHAPE, 3), 5 * FRAMES, np.float32)
    weight[16:48, 6:18, [0, 2]] = 0
    truth = scene()
    result = filled(seen_by(truth, weight), weight)
    for colour in (0, 2):
        box = np.s_[16:48, 6:18, colour]
        assert np.std(result[box] - truth[box]) < 0.25 * np.std(truth[box])


def test_thin_colours_join_the_others_without_a_jump() -> None:
    """Near the limit from which on a colour is filled, the result changes little with the number of frames."""
    truth = scene()
    results = []
    for thin in (99.0, 101.0):
        weight = np.full((*SHAPE, 3), 1000, np.float32)
        weight[20:40, 20:40, 0] = thin
        results.append(filled(truth, weight))
    np.testing.assert_allclose(*results, atol=0.01)


def test_clear_pixels_lower_the_noise_without_bias() -> None:
    truth = np.broadcast_to(np.float32([0.1, 0.06, 0.03]), (*SHAPE, 3))
    with_sum = np.concatenate([truth, truth.sum(axis=-1, keepdims=True)], axis=-1)
    weight = np.broadcast_to(np.float32([500, 500, 500, 4500]), (*SHAPE, 4))
    flux = seen_by(with_sum, weight)
    result = with_clear(flux, weight, np.ones(3), BinaryResponse())
    before, after = (each.std(axis=(0, 1)) for each in (flux[..., :3], result))
    assert result.mean(axis=(0, 1)) == pytest.approx(truth[0, 0], rel=0.01)
    assert (after < before).all()
    # The least-squares variance, from that of each colour and of the clear pixels.
    variance, clear = (np.expm1(each) / n for each, n in ((truth[0, 0], 500), (with_sum[0, 0, 3], 4500)))
    assert after == pytest.approx(np.sqrt(variance - variance**2 / (clear + variance.sum())), rel=0.05)
    assert result.sum(axis=-1).std() < 0.5 * flux[..., :3].sum(axis=-1).std()


def large(tint: np.ndarray | tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return a larger texture in one tint, and the frames that a turn of the camera gives each colour."""
    y, x = np.mgrid[:96, :128]
    truth = ((0.3 + 0.2 * np.sin(x / 1.5) * np.cos(y / 2))[..., None] * np.float32(tint)).astype(np.float32)
    return truth, np.broadcast_to(np.float32([400, 800, 400]), truth.shape)


def rms_of_colours(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((image - truth) ** 2, axis=(0, 1)))


def test_noise_of_tinted_texture_is_lower_without_bias() -> None:
    truth, weight = large((0.5, 0.8, 0.3))
    flux = seen_by(truth, weight)
    found = with_shared_detail(flux, weight, BinaryResponse())
    assert (rms_of_colours(found, truth) < [0.6, 0.9, 0.5] * rms_of_colours(flux, truth)).all()
    assert found.mean(axis=(0, 1)) == pytest.approx(flux.mean(axis=(0, 1)), rel=0.003)


def test_detail_of_single_colours_stays_with_many_photons() -> None:
    """Red and green checks of equal brightness: the sum of the colours shows nothing of them."""
    checks = (np.add.outer(np.arange(96) // 4, np.arange(128) // 4) % 2)[..., None]
    truth = np.where(checks, np.float32([0.4, 0.1, 0.2]), np.float32([0.1, 0.4, 0.2])).astype(np.float32)
    weight = 100 * large((1, 1, 1))[1]
    flux = seen_by(truth, weight)
    found = with_shared_detail(flux, weight, BinaryResponse())
    assert (rms_of_colours(found, truth) < 1.05 * rms_of_colours(flux, truth)).all()
