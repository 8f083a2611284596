"""What the conformance kit does not test of mergers: what they share with photon-mle, and what they refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Light, Merger, StageContext, Trajectory, capture_of, discover
from photonpano.capture import MaskedSpan, in_light
from photonpano.geometry import Camera, translation
from photonpano.merging import accumulate, chunks_of
from photonpano.testing import MemorySource

N, HEIGHT, WIDTH = 140, 60, 90
GROUP = Group(FrameSpan(0, N), (N - 1) / 2)
SPEED_PX = 0.1
CATALOG = discover()
Y, X = np.mgrid[:HEIGHT, :120]
SCENE = 0.3 + 0.12 * np.sin(X / 6) * np.cos(Y / 8) + np.where(X > 60, 0.15, 0)
"""Probabilities of a lit pixel: a smooth landscape with an edge."""


@pytest.fixture(scope="module")
def motion(pan: Callable) -> Trajectory:
    return pan(SPEED_PX)


def built(name: str, **keys: Any) -> Merger:
    contribution, source = CATALOG.find("merger", name).contribution, MemorySource(np.zeros((N, HEIGHT, WIDTH)))
    return contribution.build(contribution.config(**keys), StageContext(source.info, source.response))


def plain(tolerance_px: float = 0.25) -> Merger:
    return built("photon-mle", tolerance_px=tolerance_px)


def true_view(frame: float) -> np.ndarray:
    """The view of a frame that moves along x, interpolated linearly."""
    left = SPEED_PX * frame
    whole, part = int(left), left - int(left)
    return (1 - part) * SCENE[:, whole : whole + WIDTH] + part * SCENE[:, whole + 1 : whole + 1 + WIDTH]


def capture() -> MemorySource:
    rng = np.random.default_rng(0)
    return MemorySource(np.array([rng.random((HEIGHT, WIDTH)) < true_view(frame) for frame in range(N)]))


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_splat_equals_photon_mle_without_trajectory(scale: float) -> None:
    """Motion of camera and scene are not separable there."""
    source = capture()
    source.valid = np.random.default_rng(1).random((HEIGHT, WIDTH)) > 0.05
    exposure, other = (each.merge(source, GROUP, None, scale) for each in (built("splat"), plain()))
    np.testing.assert_array_equal(exposure.flux, other.flux)
    np.testing.assert_array_equal(exposure.weight, other.weight)


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("name", ["photon-mle", "local-flow"])
def test_what_a_mask_of_some_frames_leaves_out_is_not_merged(name: str, moves: bool, motion: Trajectory) -> None:
    clean, bad, hidden = capture(), np.ones((HEIGHT, WIDTH), bool), FrameSpan(10, 60)
    bad[:, 30:60] = False
    lit = clean.frames(clean.info.span)
    lit[hidden.start : hidden.stop, :, 30:60] = 1
    masked = replace(capture_of(MemorySource(lit)), masks=(MaskedSpan(hidden, bad),))
    found, expected = (built(name).merge(each, GROUP, motion if moves else None, 1.0) for each in (masked, clean))
    assert np.nanmean(found.flux[:, 20:70]) == pytest.approx(np.nanmean(expected.flux[:, 20:70]), rel=0.05)
    assert found.weight[:, 40:50].mean() == pytest.approx(N - len(hidden), abs=3)
    assert found.weight[:, :20].mean() == pytest.approx(expected.weight[:, :20].mean())


def test_changing_light_and_a_lens_that_distorts_are_errors(motion: Trajectory) -> None:
    source, merger = capture(), built("local-flow")
    with pytest.raises(InputError, match=r"local-flow does not divide by light that changes; use photon-mle"):
        merger.merge(in_light(source, Light.of_frames(np.ones(N))), GROUP, motion, 1.0)
    distorting = replace(capture_of(source), camera=Camera.of(100.0, (HEIGHT, WIDTH), (-0.1, 0, 0, 0)))
    with pytest.raises(InputError, match=r"local-flow does not warp through a lens that distorts; use photon-mle"):
        merger.merge(distorting, GROUP, motion, 1.0)


@pytest.mark.parametrize("tolerance_px", [0.25, 4.0])
def test_photon_mle_sums_chunks_within_tolerance(tolerance_px: float, motion: Trajectory) -> None:
    source, to_reference = capture(), translation(-SPEED_PX * GROUP.reference, 0)
    chunks = chunks_of(GROUP.span, motion, (HEIGHT, WIDTH), tolerance_px)
    expected, _ = accumulate(source, chunks, to_reference, (HEIGHT, WIDTH)).estimate(source.response)
    exposure = plain(tolerance_px).merge(source, GROUP, motion, 1.0)
    np.testing.assert_allclose(exposure.flux, expected, atol=1e-3)
