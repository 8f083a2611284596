"""A vignette is measured from a scene that moves through the frame, and sums are divided by it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.corrections import Vignette, divided_by, estimate_vignette
from photonpano.geometry import translation
from photonpano.testing import KnownMotion, MemorySource
from photonpano.testing.scenes import detected, seen_along

SHAPE, N = (96, 128), 600
MOTION = KnownMotion(lambda frame: translation(0.15 * float(frame), 0.04 * float(frame)))
_y, _x = np.indices(SHAPE)
RADIUS = np.hypot(_y - 47.5, _x - 63.5) / np.hypot(48, 64)


@pytest.fixture(scope="module")
def panned(street: np.ndarray) -> Callable[..., MemorySource]:
    """Return a pan over a street, seen through a lens with a vignette, in light that drifts."""

    def panned(vignette: float, flux: float, speed: float = 1.0) -> MemorySource:
        views = seen_along(street, translation(300, 250) @ MOTION.at(speed * np.arange(N)), SHAPE)
        light = flux / 0.5 * (1 + 0.5 * np.arange(N) / N)
        return MemorySource(detected(views * (1 - vignette * RADIUS**2) * light[:, None, None], 2))

    return panned


@pytest.mark.parametrize("flux", [0.5, 0.05])
def test_vignette_is_measured_from_moving_scene(flux: float, panned: Callable[..., MemorySource]) -> None:
    vignette = estimate_vignette(panned(0.8, flux), MOTION)
    assert vignette is not None
    inside = RADIUS < 0.9
    np.testing.assert_allclose(vignette.gain[inside], (1 - 0.8 * RADIUS**2)[inside], atol=0.06)
    decision = vignette.decision
    assert decision.what == "vignette_gain"
    assert decision.value == pytest.approx(vignette.gain[0, 0], abs=1e-3)
    assert decision.reason.startswith("light that reaches the corners, relative to the middle, from ")


@pytest.mark.parametrize(("vignette", "speed"), [(0.0, 1.0), (0.8, 0.0)], ids=["no vignette", "nothing moves"])
def test_vignette_is_none_where_nothing_shows_it(vignette: float, speed: float, panned: Callable[..., MemorySource]) -> None:
    motion = KnownMotion(lambda frame: MOTION.at([speed * float(frame)])[0])
    assert estimate_vignette(panned(vignette, 0.3, speed), motion) is None


def test_divided_sums_are_on_average_those_without_vignette() -> None:
    """To first order around the mean of a pixel, which is exact there."""
    gain = (1 - 0.8 * RADIUS**2).astype(np.float32)
    lit = -np.expm1(-0.7 * gain)
    source = MemorySource((np.random.default_rng(0).random((2000, *SHAPE)) < lit).astype(np.uint8))
    flat = divided_by(source, Vignette(gain, lit.astype(np.float32), (FrameSpan(0, 2000),)))
    corrected = flat.corrected(flat.counts(FrameSpan(0, 2000)), 2000) / 2000
    assert corrected.mean() == pytest.approx(-np.expm1(-0.7), abs=0.002)
    corners = RADIUS > 0.8
    assert corrected[corners].mean() == pytest.approx(-np.expm1(-0.7), abs=0.005)
