from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.corrections.colour_filter import with_colours
from photonpano.geometry import Canvas, translation
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano.photometry import BinaryResponse, flux_std
from photonpano.testing import MemorySource

N = 40
SPAN = FrameSpan(0, N)
CANVAS = Canvas(8, 12, np.eye(3))


class DarkCounts(MemorySource):
    """Subtracts dark counts that differ from pixel to pixel."""

    def __init__(self, rates: np.ndarray) -> None:
        super().__init__(np.zeros((N, *rates.shape)))
        self.rates = rates.astype(np.float32)

    def corrected(self, counts: np.ndarray, n_frames: int) -> np.ndarray:
        return np.asarray(n_frames - (n_frames - counts.astype(np.float32)) * np.exp(self.rates), np.float32)


def image(value: float, shape: tuple[int, ...] = CANVAS.shape) -> np.ndarray:
    return np.full(shape, value, np.float32)


def test_noise_of_uncorrected_source_is_that_of_its_response(pan: Callable) -> None:
    noise = CanvasNoise.of(MemorySource(np.zeros((N, 8, 12))), pan(0), SPAN, CANVAS)
    np.testing.assert_array_equal(noise.std(image(0.1), image(N)), flux_std(image(0.1), image(N), BinaryResponse()))


def test_noise_of_still_camera_follows_dark_counts_of_each_pixel(pan: Callable) -> None:
    rates = np.linspace(0.01, 0.5, 96).reshape(8, 12)
    std = CanvasNoise.of(DarkCounts(rates), pan(0), SPAN, CANVAS).std(image(0.1), image(1e6))
    np.testing.assert_allclose(std, np.sqrt(np.expm1(0.1 + rates) / 1e6), rtol=0.01)


def test_noise_of_moving_camera_follows_mean_dark_counts(pan: Callable) -> None:
    """Every pixel of the sensor passes by the middle of the canvas."""
    rates = np.tile(np.where(np.arange(12) % 2, 0.02, 0.04), (8, 1))
    noise = CanvasNoise.of(DarkCounts(rates), pan(1), SPAN, Canvas(8, 12 + N, translation(0, 0)))
    std = noise.std(image(0.1, (8, 4)), image(1e6, (8, 4)), left=24)
    np.testing.assert_allclose(std, np.sqrt(np.expm1(0.13) / 1e6), rtol=0.01)


@pytest.mark.parametrize("even", [True, False])
def test_noise_of_colours_is_that_of_their_pixels(pan: Callable, even: bool) -> None:
    """The grey source that all colours make multiplies counts by the gains of the colours, which must not count."""
    rates = np.full((8, 12), 0.2) if even else np.linspace(0.01, 0.5, 96).reshape(8, 12)
    colour = np.tile(np.int8([[0, 1], [1, 2]]), (4, 6))
    noise = CanvasNoise.of(with_colours(DarkCounts(rates), colour), pan(0), SPAN, CANVAS)
    std = noise.std(image(0.1, (8, 12, 3)), image(1e6, (8, 12, 3)))
    own = np.take_along_axis(std, colour[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(own, np.sqrt(np.expm1(0.1 + rates) / 1e6), rtol=0.01)


@pytest.mark.parametrize("colours", [0, 3])
def test_dynamic_range_is_that_of_flux_above_its_noise(colours: int) -> None:
    shape = (4, 5, 3) if colours else (4, 5)
    flux, weight = image(0.5, shape), image(10_000, shape)
    flux[0, 0], weight[0, 0] = np.nan, 0
    flux[0, 1] = 1e-5  # far below the flux of one photon
    flux[0, 2] = 0.005
    flux[0, 3] = np.log(20_001)  # lit in every frame
    found = DynamicRange(CanvasNoise(BinaryResponse()))
    found.add(flux, weight, 0, 0)
    assert found.decibels == pytest.approx(20 * np.log10(np.log(20_001) / 0.005), abs=0.01)
    assert found.saturated_share == pytest.approx(1 / 19)
    assert found.measurable_decibels == pytest.approx(99.9, abs=0.1)


def test_dynamic_range_of_nothing_is_unknown() -> None:
    found = DynamicRange(CanvasNoise(BinaryResponse()))
    found.add(image(np.nan), image(0), 0, 0)
    assert (found.decibels, found.measurable_decibels, found.saturated_share) == (None, None, 0)
