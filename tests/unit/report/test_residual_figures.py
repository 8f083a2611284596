"""The figures of the residuals: what they draw, and that every size can be drawn."""

from __future__ import annotations

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano.geometry import Canvas
from photonpano.report import residual_figures
from photonpano.residuals.block_sums import BLOCK_PX, GX_R, GXX
from photonpano.values import Light

CANVAS = Canvas(300, 1240, np.eye(3))


def test_figures_use_colour_variables_of_page(residuals):
    for svg in (
        residual_figures.misfit_over_panorama(residuals, CANVAS, CANVAS),
        residual_figures.over_sensor(residuals),
        residual_figures.shifts_over_time(residuals, None),
    ):
        ElementTree.fromstring(svg)
        assert not re.search("#0101|#0102", svg)
        assert not re.search(r"(stroke|fill): #000000", svg)
        assert "var(--" in svg
        assert len(svg) < 120_000


def test_light_is_drawn_only_if_it_changes(residuals):
    assert residual_figures.light_over_time(residuals) is None
    svg = residual_figures.light_over_time(replace(residuals, light=np.linspace(0.5, 1.5, len(residuals.spans))))
    ElementTree.fromstring(svg)
    assert "light / mean" in svg


def test_flicker_is_drawn_only_where_places_have_their_own():
    gain = np.ones(100)
    assert residual_figures.flicker_over_panorama(None, Canvas(60, 90, np.eye(3))) is None
    assert residual_figures.flicker_over_panorama(Light.of_frames(gain), Canvas(60, 90, np.eye(3))) is None
    waves, maps = np.zeros((2, 100)), np.stack([np.linspace(0, 0.8, 90 * 60).reshape(60, 90)] * 2).astype(np.float32)
    svg = residual_figures.flicker_over_panorama(Light(gain, waves, maps, np.eye(3), 0.1, gain), Canvas(60, 90, np.eye(3)))
    ElementTree.fromstring(svg)
    assert "flicker / mean light" in svg
    assert "phase (degrees)" in svg


def test_spectrum_of_noise_is_one(residuals):
    frequencies, power = residual_figures.spectrum_over_noise(residuals)
    assert (len(frequencies), frequencies[-1]) == (len(power), pytest.approx(1 / 32, rel=0.01))
    # Interpolation is expected to add 0.015 px to a noise of 0.03 px.
    assert power.mean() == pytest.approx(1 / (1 + 0.015**2 / 0.03**2), rel=0.1)


def test_spectrum_peaks_at_period_of_tremor(tremor):
    frequencies, power = residual_figures.spectrum_over_noise(tremor)
    assert 1 / frequencies[power.argmax()] == pytest.approx(100, rel=0.02)
    assert power.max() > 100


def test_spectrum_ignores_spans_without_information(tremor):
    normal = tremor.normal.copy()
    normal[::7] = 0
    frequencies, power = residual_figures.spectrum_over_noise(replace(tremor, normal=normal))
    assert 1 / frequencies[power.argmax()] == pytest.approx(100, rel=0.02)


@pytest.mark.parametrize(("rate", "label"), [(None, "cycles per frame"), (96_800.0, "frequency (Hz)")])
def test_spectrum_names_its_unit(residuals, rate, label):
    assert label in residual_figures.shifts_over_time(residuals, rate)


def test_shifts_of_blocks_are_drawn_if_significant(residuals):
    assert residual_figures.significant_shifts(residuals) is None
    blocks = residuals.blocks.copy()
    blocks[..., GX_R] = 0.2 * blocks[..., GXX]
    places, shifts = residual_figures.significant_shifts(replace(residuals, blocks=blocks))
    np.testing.assert_allclose(shifts, np.broadcast_to([0.2, 0], shifts.shape), atol=1e-12)
    np.testing.assert_allclose(places[0], (BLOCK_PX - 1) / 2)
    np.testing.assert_allclose(places[-1], [(480 + 495) / 2, (240 + 253) / 2])
    assert "0.2 px" in residual_figures.over_sensor(replace(residuals, blocks=blocks))


def test_figures_draw_residuals_of_a_single_span_that_saw_nothing(residuals):
    nothing = replace(
        residuals,
        spans=residuals.spans[:1],
        instants=residuals.instants[:1],
        normal=0 * residuals.normal[:1],
        gradient=residuals.gradient[:1],
        blocks=0 * residuals.blocks,
        block_misfit=residuals.block_misfit * np.nan,
        cell_misfit=residuals.cell_misfit * np.nan,
        cell_count=0 * residuals.cell_count,
    )
    for svg in (
        residual_figures.misfit_over_panorama(nothing, CANVAS, CANVAS),
        residual_figures.over_sensor(nothing),
        residual_figures.shifts_over_time(nothing, 100.0),
    ):
        ElementTree.fromstring(svg)
