"""Photon noise of colours, lowered by the detail that they share."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.merging.colour import with_shared_detail
from photonpano.photometry import BinaryResponse, frame_variance

SHAPE = (96, 128)
FRAMES = np.float32([400, 800, 400])


def seen_in(frames: np.ndarray, flux: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the flux that binary frames show, and its weight: (H, W, 3) each."""
    weight = np.broadcast_to(frames, flux.shape).astype(np.float32)
    counts = np.random.default_rng(seed).binomial(weight.astype(int), -np.expm1(-flux))
    return BinaryResponse().flux((counts / weight).astype(np.float32), weight), weight


def texture(tint: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return ((0.3 + 0.2 * np.sin(x / 1.5) * np.cos(y / 2))[..., None] * tint).astype(np.float32)


def rms(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean((image - truth) ** 2, axis=(0, 1)))


def test_noise_of_tinted_texture_is_lower_without_bias() -> None:
    truth = texture(np.float32([0.5, 0.8, 0.3]))
    flux, weight = seen_in(FRAMES, truth)
    found = with_shared_detail(flux, weight, BinaryResponse())
    assert (rms(found, truth) < [0.6, 0.9, 0.5] * rms(flux, truth)).all()
    assert found.mean(axis=(0, 1)) == pytest.approx(flux.mean(axis=(0, 1)), rel=0.003)


def test_detail_of_single_colours_stays_with_many_photons() -> None:
    """Red and green checks of equal brightness: the sum of the colours shows nothing of them."""
    checks = (np.add.outer(np.arange(SHAPE[0]) // 4, np.arange(SHAPE[1]) // 4) % 2)[..., None]
    truth = np.where(checks, np.float32([0.4, 0.1, 0.2]), np.float32([0.1, 0.4, 0.2])).astype(np.float32)
    flux, weight = seen_in(100 * FRAMES, truth)
    found = with_shared_detail(flux, weight, BinaryResponse())
    assert (rms(found, truth) < 1.05 * rms(flux, truth)).all()


def test_frame_variance_is_the_binomial_one() -> None:
    flux = np.float32([0.01, 0.1, 1, 3])
    assert frame_variance(flux, BinaryResponse()) == pytest.approx(np.expm1(flux), rel=0.01)
