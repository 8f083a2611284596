"""The filter of measured steps: it keeps what exceeds the noise, and says what it let through."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.filtering import exceeding_noise

STEPS = np.arange(1000)


def noise(seed: int, std: float = 0.3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, std, len(STEPS))


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_is_left_out(seed: int) -> None:
    filtered = exceeding_noise(noise(seed), np.full(len(STEPS), 0.3**2))
    assert np.sqrt(np.mean(filtered.signal**2)) < 0.03
    assert filtered.std.max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_tremor_is_kept_and_its_noise_known(seed: int) -> None:
    tremor = np.sin(2 * np.pi * STEPS / 11) + 0.5 * np.sin(2 * np.pi * STEPS / 37)
    filtered = exceeding_noise(tremor + noise(seed), np.full(len(STEPS), 0.3**2))
    error = np.sqrt(np.mean((filtered.signal - tremor) ** 2))
    assert error < 0.15
    assert 0.5 < error / np.sqrt(np.mean(filtered.std**2)) < 2


def test_unknown_steps_count_for_nothing() -> None:
    tremor, variances = np.sin(2 * np.pi * STEPS / 11), np.full(len(STEPS), 0.1**2)
    variances[::10] = np.inf
    steps = tremor + noise(0, 0.1)
    steps[::10] = 1e6
    filtered = exceeding_noise(steps, variances)
    assert np.abs(filtered.signal).max() < 2
    nothing = exceeding_noise(steps, np.full(len(STEPS), np.inf))
    assert not nothing.signal.any()
    assert not nothing.std.any()
