"""Sums of frames in changing light are divided by the sum of their gains."""

import numpy as np
import pytest

from photonpano import FrameSpan, Light, Response
from photonpano.capture import in_light
from photonpano.geometry import translation
from photonpano.merging import Chunk, accumulate
from photonpano.merging.accumulate import LitFrames, gain_image
from photonpano.photometry import BinaryResponse, IntensityResponse
from photonpano.testing import MemorySource

SHAPE, N = (24, 32), 400
FLICKER = 1 + np.cos(2 * np.pi * np.arange(N) / 100)


def in_flicker(flux: float, gain: np.ndarray, valid: np.ndarray | None = None) -> MemorySource:
    """Frames of an even scene, lit with the probability 1 - exp(-gain flux)."""
    chance = -np.expm1(-gain * flux)[:, None, None]
    return MemorySource(np.random.default_rng(1).random((len(gain), *SHAPE)) < chance, valid)


@pytest.mark.parametrize("flux", [0.05, 0.5, 2.0])
def test_flux_in_deep_flicker_is_unbiased_up_to_bright_pixels(flux: float) -> None:
    source = in_light(in_flicker(flux, FLICKER), Light.of_frames(FLICKER))
    photons = accumulate(source, [Chunk(FrameSpan(0, N), np.eye(3))], np.eye(3), SHAPE)
    estimate, weight = photons.estimate(source.response)
    noise = np.sqrt(np.expm1(flux) / (N * estimate.size)) * 3
    assert float(estimate.mean()) == pytest.approx(flux, abs=4 * noise + 0.005 * flux)
    np.testing.assert_allclose(weight, FLICKER.sum(), rtol=1e-4)


@pytest.mark.parametrize(
    ("frames", "gains", "counts", "response", "flux"),
    [
        ([100], [50], 30, BinaryResponse(), -np.log1p(-0.3) / 0.5),
        ([60, 40], [30, 80], 550, IntensityResponse(2.0, 0.0, 255, 0.0), 2 * 550 / 110),
    ],
    ids=["one gain", "a linear response needs only the sum of gains"],
)
def test_flux_of_known_gains_is_exact(
    frames: list[float], gains: list[float], counts: float, response: Response, flux: float
) -> None:
    lit = LitFrames(*(np.float32(each).reshape(-1, 1, 1) for each in (frames, gains)))
    np.testing.assert_allclose(lit.flux(np.float32([[counts]]), response), flux, rtol=1e-5)


def test_gains_are_counted_where_frames_lie_with_and_without_a_mask() -> None:
    valid = np.ones(SHAPE, np.bool_)
    valid[5, 7] = False
    for mask in (None, valid):
        source = in_light(in_flicker(0.5, FLICKER, mask), Light.of_frames(FLICKER))
        chunks = [Chunk(FrameSpan(0, 50), np.eye(3)), Chunk(FrameSpan(50, 100), translation(4, 0))]
        weight = accumulate(source, chunks, np.eye(3), SHAPE).weight
        np.testing.assert_allclose(weight[10, 10], FLICKER[:100].sum(), rtol=1e-5)
        np.testing.assert_allclose(weight[10, 2], FLICKER[:50].sum(), rtol=1e-5)
        if mask is not None:
            np.testing.assert_allclose(weight[5, 7], FLICKER[50:100].sum(), rtol=1e-5)


def test_gain_of_lamps_follows_the_place_of_the_frame() -> None:
    maps = np.zeros((2, 1, 40), np.float32)
    maps[0] = np.linspace(0, 0.39, 40)
    waves = np.stack([np.cos(np.arange(8)), np.sin(np.arange(8))])
    light = Light(np.ones(8), waves, maps, np.eye(3), 1 / (2 * np.pi), np.zeros(8))
    image = gain_image(light, FrameSpan(3, 4), translation(6, 0), (4, 10))
    np.testing.assert_allclose(image[2], 1 + np.cos(3) * 0.01 * (np.arange(10) + 6), atol=1e-5)


def test_lamps_around_a_camera_are_where_it_looks() -> None:
    """Amplitudes on a sphere, in steps of half a degree, are those of the directions of a frame turned by 70 degrees."""
    camera_matrix, turned = np.array([[90.0, 0, 49.5], [0, 90, 24.5], [0, 0, 1]]), np.deg2rad(70)
    maps = np.zeros((2, 80, 400), np.float32)
    maps[0] = 0.002 * np.arange(400)
    to_map = np.array([[360 / np.pi, 0, 100], [0, 360 / np.pi, 40], [0, 0, 1]])
    light = Light(np.ones(1), np.ones((2, 1)), maps, to_map, 0.1, np.zeros(1), camera_matrix)
    turn = np.array([[np.cos(turned), 0, np.sin(turned)], [0, 1, 0], [-np.sin(turned), 0, np.cos(turned)]])
    image = gain_image(light, FrameSpan(0, 1), camera_matrix @ turn @ np.linalg.inv(camera_matrix), (50, 100))
    directions = 70 + np.rad2deg(np.arctan2(np.arange(100) - 49.5, 90))
    np.testing.assert_allclose(image[24], 1 + 0.002 * (100 + 2 * directions), atol=1e-4)
