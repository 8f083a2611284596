"""The noise of panoramas, and how interpolation lowers it."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from photonpano import FrameSpan
from photonpano.capture import Capture, capture_of
from photonpano.corrections.colour_filter import with_colours
from photonpano.geometry import Canvas, rescaling, translation
from photonpano.merging import accumulate, canvas_noise
from photonpano.merging.accumulate import chunks_of
from photonpano.merging.canvas_noise import Averaging, CanvasNoise, DynamicRange
from photonpano.photometry import BinaryResponse
from photonpano.testing import KnownMotion, MemorySource
from photonpano.values import Light

SHAPE = (24, 32)
STILL = KnownMotion(lambda _: np.eye(3))


def factor(motion: KnownMotion, canvas: Canvas, n_frames: int = 400) -> np.ndarray:
    return Averaging.of(motion, FrameSpan(0, n_frames), SHAPE, canvas=canvas).over(canvas.shape).std_factor


def test_averaging_is_that_of_merged_photons() -> None:
    """The scatter of sums of frames of equal flux, over that without interpolation."""
    motion = KnownMotion(lambda frame: translation(0.011 * frame, 3 * np.sin(frame / 20)))
    frames = np.random.default_rng(0).random((600, *SHAPE)) < 0.3
    canvas, span = Canvas(14, 16, translation(-12, -5)), FrameSpan(0, 600)
    chunks = chunks_of(span, motion, SHAPE, 0.05)
    summed = accumulate(MemorySource(frames), chunks, canvas.transform, canvas.shape)
    scatter = (summed.counts - 0.3 * summed.weight) / np.sqrt(0.21 * summed.weight)
    assert np.sqrt(np.mean((scatter / factor(motion, canvas, 600)) ** 2)) == pytest.approx(1, abs=0.1)


N = 40
SPAN = FrameSpan(0, N)
CANVAS = Canvas(8, 12, np.eye(3))


def dark_counts(rates: np.ndarray) -> Capture:
    """Return a capture that subtracts dark counts, which differ from pixel to pixel."""

    def corrected(counts: np.ndarray, n_frames: int) -> np.ndarray:
        return np.asarray(n_frames - (n_frames - counts.astype(np.float32)) * np.exp(rates.astype(np.float32)), np.float32)

    return replace(capture_of(MemorySource(np.zeros((N, *rates.shape)))), steps=(corrected,))


def image(value: float, shape: tuple[int, ...] = CANVAS.shape) -> np.ndarray:
    return np.full(shape, value, np.float32)


def test_noise_of_still_camera_follows_dark_counts_of_each_pixel(pan: Callable) -> None:
    rates = np.linspace(0.01, 0.5, 96).reshape(8, 12)
    std = CanvasNoise.of(dark_counts(rates), pan(0), SPAN, CANVAS).std(image(0.1), image(1e6))
    np.testing.assert_allclose(std, np.sqrt(np.expm1(0.1 + rates) / 1e6), rtol=0.01)


@pytest.mark.parametrize("even", [True, False])
def test_noise_of_colours_is_that_of_their_pixels(pan: Callable, even: bool) -> None:
    """The grey source that all colours make multiplies counts by the gains of the colours, which must not count."""
    rates = np.full((8, 12), 0.2) if even else np.linspace(0.01, 0.5, 96).reshape(8, 12)
    colour = np.tile(np.int8([[0, 1], [1, 2]]), (4, 6))
    noise = CanvasNoise.of(with_colours(dark_counts(rates), colour), pan(0), SPAN, CANVAS)
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
    found = DynamicRange(noise=CanvasNoise(response=BinaryResponse()))
    found.add(flux, weight, found.noise.std(flux, weight))
    assert found.decibels == pytest.approx(20 * np.log10(np.log(20_001) / 0.005), abs=0.01)
    assert found.saturated_share == pytest.approx(1 / 19)
    assert found.measurable_decibels == pytest.approx(99.9, abs=0.1)


@pytest.mark.parametrize("light", [1.0, 0.3, 0.1, 0.03])
def test_range_does_not_grow_as_the_light_falls(light: float) -> None:
    """The scene has 20 dB. The lowest of many noisy pixels would add to that."""
    flux, n_frames = light * np.repeat([0.05, 0.5], 20_000).reshape(200, 200), 1000
    counts = np.random.default_rng(0).binomial(n_frames, -np.expm1(-flux)).astype(np.float32)
    measured, weight = -np.log1p(-counts / n_frames), np.full(counts.shape, n_frames, np.float32)
    found = DynamicRange(noise=CanvasNoise(response=BinaryResponse()))
    found.add(measured, weight, found.noise.std(measured, weight))
    assert found.decibels is not None
    assert found.decibels < 28


def test_noise_of_weighted_pixels_is_that_of_their_counts(pan: Callable) -> None:
    """The weight of a frame of weight w is w, but its photons say as much as before."""
    rates, weights = np.full((8, 12), 0.2), np.linspace(0.3, 1, 96).reshape(8, 12).astype(np.float32)
    noise = CanvasNoise.of(replace(capture_of(dark_counts(rates)), weight=weights), pan(0), SPAN, CANVAS)
    std = noise.std(image(0.1), weights * np.float32(1e6))
    np.testing.assert_allclose(std, np.sqrt(np.expm1(0.3) / 1e6), rtol=0.01)


SMOOTH = cv2.GaussianBlur(np.random.default_rng(0).random((60, 80)).astype(np.float32), (0, 0), 2.5)


def whole_std(flux: np.ndarray, source: MemorySource | None = None, size: float = 1.0, std_px: float = 0.0) -> np.ndarray:
    """Return the standard deviation of flux without photon noise that all frames show in the same place."""
    source = source or MemorySource(np.zeros((N, *flux.shape)))
    canvas = Canvas(*flux.shape, rescaling(size))
    noise = CanvasNoise.of(source, STILL, SPAN, canvas, np.full(N, std_px))
    parts = [found.whole for _, found in noise.of_tile(flux, np.full_like(flux, 1e12), 0, 0)]
    return np.concatenate(parts)


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_uncertain_motion_changes_flux_by_its_gradient(size: float) -> None:
    """Shifted by errors of half the expected corner error along each direction, the flux scatters as expected."""
    angles = np.arange(12) * np.pi / 6
    errors = 0.5 * 0.1 * size * np.sqrt(2) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    moves = [ndimage.shift(SMOOTH, error) for error in errors]
    inner = np.s_[4:-4, 4:-4]
    scatter, found = np.std(moves, axis=0)[inner], whole_std(SMOOTH, size=size, std_px=0.1)[inner]
    assert np.sqrt(np.mean(found**2) / np.mean(scatter**2)) == pytest.approx(1, abs=0.05)
    assert np.corrcoef(found.ravel(), scatter.ravel())[0, 1] > 0.97


def test_uncertainty_does_not_depend_on_the_parts_it_is_computed_in(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = whole_std(SMOOTH, std_px=0.3)
    monkeypatch.setattr(canvas_noise, "_BLOCK", 7 * 80)
    np.testing.assert_allclose(whole_std(SMOOTH, std_px=0.3), at_once, rtol=1e-5)


def test_uncertain_light_changes_flux_in_proportion() -> None:
    light = Light.of_frames(np.ones(N), std=np.full(N, 0.03))
    source = replace(capture_of(MemorySource(np.zeros((N, 60, 80)))), light=light)
    np.testing.assert_allclose(whole_std(np.full((60, 80), 0.5, np.float32), source), 0.015, rtol=1e-3)


@pytest.mark.parametrize("averaged", [True, False])
def test_flux_of_pixel_that_was_lit_in_every_frame_is_a_lower_bound(averaged: bool) -> None:
    """Half a dark frame of 1,000 passes for the mean: the lamp is that bright, or brighter."""
    flux, weight = np.full((6, 8), 0.5, np.float32), np.full((6, 8), 1e3, np.float32)
    flux[2, 3] = np.log(2 * 1e3 + 1)
    still = CanvasNoise.of(MemorySource(np.zeros((N, 6, 8))), STILL, SPAN, Canvas(6, 8, rescaling(1)), np.zeros(N))
    noise = still if averaged else CanvasNoise(response=BinaryResponse())
    [(_, found)] = noise.of_tile(flux, weight, 0, 0)
    np.testing.assert_array_equal(np.argwhere(np.isinf(found.whole)), [[2, 3]])
    assert np.isfinite(found.photons).all()
