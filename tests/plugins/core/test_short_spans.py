"""The refiner `short-spans`, on series whose tremor and noise are known."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan, SpanResiduals
from photonpano.geometry import FrameTrajectory
from photonpano_core.configs import ShortSpansConfig
from photonpano_core.refiners import ShortSpansRefiner

SHAPE = (96, 128)
N_FRAMES = 4096
SPAN = 8
NOISE_PX = 0.03
STILL = np.tile(np.eye(3), (N_FRAMES, 1, 1))


def spans() -> tuple[FrameSpan, ...]:
    return tuple(FrameSpan(start, start + SPAN) for start in range(0, N_FRAMES, SPAN))


def residuals(seed: int, tremor_px: float = 0.0, period: float = 76.0) -> SpanResiduals:
    """Make steps of photon noise, and a tremor along x."""
    random = np.random.default_rng(seed)
    std = np.array([NOISE_PX, NOISE_PX, NOISE_PX / 80, NOISE_PX / 80])
    steps = random.normal(size=(len(spans()), 4)) * std
    steps[:, 0] += tremor_px * np.sqrt(2) * np.sin(2 * np.pi * np.array([span.centre for span in spans()]) / period)
    return SpanResiduals(spans(), steps, np.broadcast_to(np.diag(1 / std**2), (len(steps), 4, 4)))


def refine(found: SpanResiduals, frame_rate_hz: float | None = None, known: np.ndarray = STILL):
    refiner = ShortSpansRefiner(ShortSpansConfig(), SHAPE, frame_rate_hz)
    return refiner.refine(None, FrameTrajectory(known), np.full(N_FRAMES, 0.02), found, None)


@pytest.mark.parametrize("seed", range(20))
def test_refine_corrects_nothing_where_steps_are_noise(seed: int) -> None:
    assert refine(residuals(seed)) is None


@pytest.mark.parametrize("tremor_px", [0.1, 1.0])
def test_refine_follows_tremor_to_a_fraction_of_noise(tremor_px: float) -> None:
    refined = refine(residuals(0, tremor_px))
    frames = np.arange(N_FRAMES)
    true = tremor_px * np.sqrt(2) * np.sin(2 * np.pi * frames / 76)
    found = refined.homographies[:, 0, 2] - refined.homographies[:, 0, 2].mean()
    inside = slice(100, -100)
    error = np.sqrt(np.mean((found - true + true[inside].mean())[inside] ** 2))
    assert error < NOISE_PX
    # The filter lets through the noise of few frequencies, and its std_px covers the error.
    assert error < 1.5 * np.sqrt(np.mean(refined.std_px[inside] ** 2)) < 3 * NOISE_PX


def test_refine_follows_tremor_through_gaps_without_light() -> None:
    random, instants = np.random.default_rng(0), np.array([span.centre for span in spans()])
    noise_px = NOISE_PX / np.clip(0.5 + 0.5 * np.cos(2 * np.pi * instants / 200), 0.01, 1) ** 0.5
    std = noise_px[:, None] * [1, 1, 1 / 80, 1 / 80]
    steps = random.normal(size=std.shape) * std
    steps[:, 0] += 0.5 * np.sqrt(2) * np.sin(2 * np.pi * instants / 95)
    information = np.stack([np.diag(each) for each in 1 / std**2])
    refined = refine(SpanResiduals(spans(), steps, information))
    found = refined.homographies[:, 0, 2] - refined.homographies[:, 0, 2].mean()
    error = (found - 0.5 * np.sqrt(2) * np.sin(2 * np.pi * np.arange(N_FRAMES) / 95))[100:-100]
    # A filter that leaves out steps of large noise misses half of the tremor there.
    assert np.sqrt(np.mean(error**2)) < NOISE_PX
    assert np.mean(np.abs(error) < 2 * refined.std_px[100:-100]) > 0.9


def test_refine_names_frequencies() -> None:
    corrected = "motion of 0.5 px within groups was corrected; the image trembles"
    assert refine(residuals(0, 0.5), 96_800).summary == f"{corrected} at 1,276 Hz"
    assert refine(residuals(0, 0.5)).summary == f"{corrected} with periods of 76 frames"


def test_neither_the_path_nor_pixels_that_pass_are_named_as_a_tremor() -> None:
    assert "trembles" not in refine(residuals(0, 0.5, period=N_FRAMES / 4)).summary
    passing = STILL.copy()
    passing[:, 0, 2] = np.arange(N_FRAMES) / 76  # a pixel every 76 frames
    assert "trembles" not in refine(residuals(0, 0.5), known=passing).summary
