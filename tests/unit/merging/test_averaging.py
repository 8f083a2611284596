from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import Canvas, rescaling, translation
from photonpano.merging import accumulate
from photonpano.merging.averaging import Averaging
from photonpano.merging.chunks import chunks_of
from photonpano.testing import KnownMotion, MemorySource

SHAPE = (24, 32)
STILL = KnownMotion(lambda _: np.eye(3))


def factor(motion: KnownMotion, canvas: Canvas, n_frames: int = 400) -> np.ndarray:
    return Averaging.of(motion, FrameSpan(0, n_frames), SHAPE, canvas).std_factor(canvas.shape)


@pytest.mark.parametrize(("shift", "expected"), [(0.0, 1.0), (0.5, 0.5)])
def test_averaging_of_still_camera_follows_from_place_between_pixels(shift: float, expected: float) -> None:
    np.testing.assert_allclose(factor(STILL, Canvas(8, 8, translation(-8 - shift, -8 - shift))), expected, rtol=1e-6)


def test_averaging_of_pan_by_whole_steps_is_not_that_of_its_instants(pan: Callable) -> None:
    """A pan along x passes all fractions of a pixel: the mean of `a^2 + (1 - a)^2` is 2 / 3."""
    found = factor(pan(0.02), Canvas(8, 8, translation(-12, -8)))
    np.testing.assert_allclose(found, np.sqrt(2 / 3), rtol=0.03)


def test_averaging_of_smaller_canvas_is_that_of_summed_squares() -> None:
    np.testing.assert_allclose(factor(STILL, Canvas(12, 16, rescaling(0.5)))[2:-2, 2:-2], 0.5, rtol=1e-6)


def test_averaging_of_a_part_is_the_part() -> None:
    motion = KnownMotion(lambda frame: translation(0.02 * frame, 0.01 * frame))
    canvas = Canvas(28, 40, np.eye(3))
    averaging = Averaging.of(motion, FrameSpan(0, 400), SHAPE, canvas)
    np.testing.assert_allclose(averaging.std_factor((6, 7), 9, 12), averaging.std_factor(canvas.shape)[9:15, 12:19], rtol=0.01)


def test_averaging_is_that_of_merged_photons() -> None:
    """The scatter of sums of frames of equal flux, over that without interpolation."""
    motion = KnownMotion(lambda frame: translation(0.011 * frame, 3 * np.sin(frame / 20)))
    frames = np.random.default_rng(0).random((600, *SHAPE)) < 0.3
    canvas, span = Canvas(14, 16, translation(-12, -5)), FrameSpan(0, 600)
    chunks = chunks_of(span, motion, SHAPE, 0.05)
    summed = accumulate(MemorySource(frames), chunks, canvas.transform, canvas.shape)
    scatter = (summed.counts - 0.3 * summed.weight) / np.sqrt(0.21 * summed.weight)
    assert np.sqrt(np.mean((scatter / factor(motion, canvas, 600)) ** 2)) == pytest.approx(1, abs=0.1)
