from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan, Group, VirtualExposure
from photonpano.photometry import BinaryResponse, signal_to_noise

RESPONSE = BinaryResponse()


def photographed(flux: np.ndarray, frames: int) -> VirtualExposure:
    counts = np.random.default_rng(0).binomial(frames, -np.expm1(-flux))
    weight = np.full(flux.shape, frames, np.float32)
    estimate = RESPONSE.flux((counts / frames).astype(np.float32), weight)
    return VirtualExposure(estimate, weight, Group(FrameSpan(0, frames), 0), 1.0, RESPONSE)


def waves(amplitude: float) -> np.ndarray:
    """Flux whose arcsin(sqrt(mean count)) is a wave, much longer than the averaged blocks."""
    x = np.arange(300)[None] + np.zeros((200, 1))
    return -np.log1p(-(np.sin(np.pi / 4 + amplitude * np.sin(x / 20)) ** 2))


def test_signal_to_noise_of_noise_is_near_0() -> None:
    assert signal_to_noise(photographed(np.full((200, 300), 0.5), 100)) < 0.1


@pytest.mark.parametrize(("amplitude", "frames"), [(0.05, 100), (0.2, 100), (0.05, 400)])
def test_signal_to_noise_is_contrast_over_photon_noise(amplitude: float, frames: int) -> None:
    """The standard deviation of a wave is its amplitude / sqrt(2), that of the noise of n frames 1 / (2 sqrt(n))."""
    expected = amplitude / np.sqrt(2) * 2 * np.sqrt(frames)
    assert signal_to_noise(photographed(waves(amplitude), frames)) == pytest.approx(expected, rel=0.05)


def test_signal_to_noise_ignores_unseen_pixels() -> None:
    exposure = photographed(np.full((200, 300), 0.5), 100)
    exposure.flux[:, :170], exposure.weight[:, :170] = np.nan, 0
    assert signal_to_noise(exposure) < 0.1
    exposure.flux[:], exposure.weight[:] = np.nan, 0
    assert signal_to_noise(exposure) == 0
