"""Motion that is faster than a span."""

import numpy as np
import pytest

from photonpano.residuals.patterns import find_shaking, scatter_px

WINDOWS, FRAMES, SPAN = 16, 36, 12
NOISE_PX = 0.1


def noisy(seed: int, period: float | None = None, size_px: float = 0.5) -> np.ndarray:
    """Shifts of single frames: photon noise, and a sine along x whose root mean square is `size_px`."""
    rng = np.random.default_rng(seed)
    shifts = rng.normal(0, NOISE_PX, (WINDOWS, FRAMES, 2))
    if period is not None:
        frames = 500 * np.arange(WINDOWS)[:, None] + np.arange(FRAMES)
        shifts[..., 0] += np.sqrt(2) * size_px * np.sin(2 * np.pi * frames / period + rng.uniform(0.5, 1))
    return shifts


VARIANCES = np.full((WINDOWS, FRAMES, 2), NOISE_PX**2)


@pytest.mark.parametrize("period", [2.0, 3.0, 4.5, 6.2, 11.5, 12.0, 12.5])
def test_shaking_within_a_span_is_found_with_its_period(period: float) -> None:
    found = find_shaking(noisy(1, period), VARIANCES, SPAN)
    # A sine of period 2 is seen at one phase only, by up to sqrt(2) times its root mean square.
    assert found.size_px == pytest.approx(0.5, rel=0.5)
    assert found.period_frames == pytest.approx(period, rel=0.1)
    assert found.span_frames <= max(1, period / 2)


def test_noise_does_not_shake() -> None:
    found = [find_shaking(noisy(seed), VARIANCES, SPAN) for seed in range(200)]
    # Four standard deviations of each of two directions.
    assert sum(each.size_px > 0 for each in found) <= 1
    assert {each.span_frames for each in found if not each.size_px} == {SPAN}


def test_directions_without_texture_hide_no_shaking_of_the_other() -> None:
    variances = VARIANCES * [1, 1e4]
    assert scatter_px(noisy(3, 4.0) * [1, 100], variances, SPAN) == pytest.approx(0.5, rel=0.2)
    assert scatter_px(noisy(3, 4.0), np.full(VARIANCES.shape, np.inf), SPAN) == 0
