"""The gain of the pixels is told from the brightness of a scene that moves through the frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from photonpano import InputError
from photonpano.context import Context
from photonpano.corrections import Vignette, divided_by
from photonpano.geometry import Canvas, translation
from photonpano.lighting import PixelGain, measure_pixel_gain
from photonpano.merging.panorama import render
from photonpano.protocols import WeightedSource
from photonpano.testing import KnownMotion, MemorySource
from photonpano.testing.scenes import detected, seen_along
from photonpano.values import FrameSpan

SHAPE, N = (64, 96), 120
Y, X = np.indices(SHAPE) / 32
GAIN = np.exp(0.3 * np.sin(2 * X + 0.5) * np.cos(1.5 * Y) + 0.1 * X)
GAIN /= GAIN.mean()
"""Brighter and darker by 30 % over distances of 50 px, and brighter to the right."""
EVEN = np.ones(SHAPE)


def path(frame: float) -> np.ndarray:
    """Move through the scene, in both directions and back again."""
    turn = 2 * np.pi * frame / N
    return translation(50 * np.sin(3 * turn), 40 * np.sin(2 * turn))


MOTION = KnownMotion(path)


@pytest.fixture(scope="module")
def recorded(street: np.ndarray) -> Callable[..., MemorySource]:
    """Record a street, seen with this gain along this motion."""

    @cache
    def recorded(uneven: bool, motion: KnownMotion = MOTION) -> MemorySource:
        views = seen_along(street, translation(300, 250) @ motion.at(np.arange(N)), SHAPE)
        return MemorySource(detected(0.4 * views * (GAIN if uneven else EVEN)))

    return recorded


@pytest.fixture(scope="module")
def measured(recorded: Callable[..., MemorySource]) -> Callable[..., PixelGain]:
    """Measure the gain of a recorded capture along its motion."""
    return cache(lambda uneven: measure_pixel_gain(recorded(uneven), MOTION, Context()))


@pytest.mark.parametrize(("uneven", "most"), [(True, 0.04), (False, 0.02)], ids=["uneven", "even"])
def test_gain_is_measured_to_its_expected_error(uneven: bool, most: float, measured: Callable[..., PixelGain]) -> None:
    found = measured(uneven)
    error = found.gain / (GAIN if uneven else EVEN) - 1
    rms, expected = (float(np.sqrt(np.mean(each**2))) for each in (error, found.std))
    assert rms < 1.5 * expected
    assert expected < most


def rendered(source: MemorySource, found: PixelGain | None) -> np.ndarray:
    """Return the flux of what most frames saw: (60, 80)."""
    whole = FrameSpan(0, N)
    if found is not None:
        mean = (source.counts(whole) / N).astype(np.float32)
        source = divided_by(source, Vignette(found.gain, mean, found.spans, found.std))
        assert isinstance(source, WeightedSource)
    canvas = Canvas(60, 80, translation(-8, -2))
    return render(source, MOTION, whole, canvas, 0.1, Context()).flux


@pytest.mark.parametrize(("uneven", "most"), [(True, 0.04), (False, 0.02)], ids=["uneven", "even"])
def test_divided_panorama_is_that_of_an_even_sensor(
    uneven: bool, most: float, recorded: Callable[..., MemorySource], measured: Callable[..., PixelGain]
) -> None:
    """Its contrast is that of the scene, of which the flat field takes nothing."""
    divided, truth = rendered(recorded(uneven), measured(uneven)), rendered(recorded(False), None)
    assert np.std(divided) / np.mean(divided) == pytest.approx(np.std(truth) / np.mean(truth), rel=most)


def test_camera_that_stands_still_is_refused(recorded: Callable[..., MemorySource]) -> None:
    still = KnownMotion(lambda _: np.eye(3))
    expected = r"^corrections: flat-field: photons and motion determine 0% of the variance of the gain, and 50% are needed;"
    with pytest.raises(InputError, match=expected):
        measure_pixel_gain(recorded(True, still), still, Context())
