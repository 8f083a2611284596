"""Residuals of photons against a panorama: on simulated captures whose motion is known, they are photon noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from photonpano.context import Context
from photonpano.geometry import FrameTrajectory, translation
from photonpano.merging.canvas_plan import plan_canvas
from photonpano.merging.panorama import render
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.prediction import Predictions
from photonpano.residuals.refinement import bounded_std_px, residual_ratio, unexplained_px
from photonpano.testing.captures import KnownMotion, ReadOnlySource, recorded
from photonpano.testing.scenes import Scene

SHAPE = (48, 80)
FRAMES = 800
PERIOD = 90


def shaken(frame: float, tremor_px: float) -> np.ndarray:
    tremor = tremor_px * np.sin(2 * np.pi * frame / PERIOD)
    return translation(0.08 * frame + tremor, 0.02 * frame)


@cache
def capture(tremor_px: float = 0.0) -> ReadOnlySource:
    motion = KnownMotion(lambda frame: shaken(frame, tremor_px))
    return ReadOnlySource(recorded(Scene(seed=5, flux=(0.1, 0.8)), motion, FRAMES, SHAPE))


def residuals_of(source, tremor_px: float = 0.0, threads: int = 1) -> Residuals:
    """Measure the residuals of a capture along a path with a tremor."""
    trajectory = FrameTrajectory(np.array([shaken(frame, tremor_px) for frame in range(FRAMES)]))
    span = source.info.span
    canvas = plan_canvas(trajectory, span, SHAPE, 1.0, 2**30)
    panorama = render(source, trajectory, span, canvas, 0.25, Context())
    return measure(span, Predictions.of(source, panorama, canvas, trajectory, SHAPE), Context(threads))


def test_measure_finds_photon_noise_along_true_motion() -> None:
    found = residuals_of(capture())
    assert found.misfit.mean() == pytest.approx(1, abs=0.1)
    assert residual_ratio(found) == pytest.approx(1, abs=0.2)
    assert np.nanmean(found.block_misfit) == pytest.approx(1, abs=0.1)
    gains, stds = found.gains()
    assert (gains / stds).std() == pytest.approx(1, abs=0.15)
    assert unexplained_px(found, FRAMES).max() < 0.05


def test_steps_are_the_tremor_that_the_motion_lacks() -> None:
    found = residuals_of(capture(0.4))
    steps = found.steps()
    expected = 0.4 * np.sin(2 * np.pi * found.instants / PERIOD)
    slope = (steps.steps[:, 0] * expected).sum() / (expected**2).sum()
    # The panorama is blurred by the tremor, too, which makes it seem smaller.
    assert 0.7 < slope < 1.1
    assert residual_ratio(found) > 2
    assert unexplained_px(found, FRAMES).mean() == pytest.approx(0.4 / np.sqrt(2), rel=0.35)


def test_bounded_std_px_at_an_extrapolated_end_is_what_the_photons_allow() -> None:
    found = residuals_of(capture())
    std_px = np.full(FRAMES, 0.1)
    std_px[-40:] = np.linspace(0.1, 10, 40)
    std_px[:5] = np.inf
    bounded = bounded_std_px(std_px, found)
    np.testing.assert_array_equal(bounded[:700], std_px[:700])
    assert bounded[-40:].max() < 1
    assert (bounded[-40:] >= 0.1).all()


def test_bounded_std_px_keeps_the_error_that_photons_show() -> None:
    found = residuals_of(capture(0.4))
    assert bounded_std_px(np.full(FRAMES, 10.0), found).min() == 10


def test_bounded_std_px_of_frames_that_show_nothing_stays_as_it_was() -> None:
    found = residuals_of(capture())
    dark = (found.instants > 400) & (found.instants < 600)
    gradient = found.gradient.copy()
    gradient[dark, -1] = -found.normal[dark, -1, -1]
    frames = np.arange(FRAMES)
    bounded = bounded_std_px(np.where((frames > 450) & (frames < 640), 10.0, 0.1), replace(found, gradient=gradient))
    assert bounded[460:580].min() == 10
    assert bounded[630:].max() < 1


def test_scatter_of_steps_is_their_information() -> None:
    found = residuals_of(capture()).steps()
    chi2 = np.einsum("si,sij,sj->s", found.steps, found.information, found.steps) / 4
    assert chi2.mean() == pytest.approx(1, abs=0.2)


def test_measure_does_not_depend_on_threads() -> None:
    one, two = residuals_of(capture()), residuals_of(capture(), threads=3)
    for name in ("normal", "gradient", "misfit", "blocks", "block_misfit", "pixel_gain", "cell_misfit"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)


def test_spans_contain_every_frame_once() -> None:
    spans = residuals_of(capture()).spans
    assert spans[0].start == 0
    assert spans[-1].stop == FRAMES
    assert all(one.stop == two.start for one, two in pairwise(spans))


def test_predicted_view_is_the_scene_and_its_variance() -> None:
    source = capture()
    trajectory = FrameTrajectory(np.array([shaken(frame, 0) for frame in range(FRAMES)]))
    canvas = plan_canvas(trajectory, source.info.span, SHAPE, 1.0, 2**30)
    panorama = render(source, trajectory, source.info.span, canvas, 0.25, Context())
    mean, variance = Predictions.of(source, panorama, canvas, trajectory, SHAPE).predicted(400)
    true = -np.expm1(-Scene(seed=5, flux=(0.1, 0.8)).view(shaken(400, 0), SHAPE))
    seen = np.isfinite(mean)
    assert seen.mean() > 0.9
    assert np.abs(mean - true)[seen].mean() < 0.02
    np.testing.assert_allclose(variance[seen], (mean * (1 - mean))[seen], rtol=0.35, atol=0.02)
