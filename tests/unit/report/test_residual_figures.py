"""The figures of the residuals."""

import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano.geometry import Canvas
from photonpano.report import figures
from photonpano.residuals.block_sums import BLOCK_PX, GX_R, GXX

CANVAS = Canvas(300, 1240, np.eye(3))


def test_figures_use_colour_variables_of_page(residuals):
    for svg in (
        figures.chi2_over_panorama(residuals, CANVAS, CANVAS),
        figures.over_sensor(residuals),
        figures.shifts_over_time(residuals, None),
    ):
        ElementTree.fromstring(svg)
        assert not re.search("#0101|#0102", svg)
        assert not re.search(r"(stroke|fill): #000000", svg)
        assert "var(--" in svg
        assert len(svg) < 120_000


def test_spectrum_peaks_at_period_of_tremor(tremor):
    frequencies, power = figures.spectrum_over_noise(tremor)
    assert 1 / frequencies[power.argmax()] == pytest.approx(100, rel=0.02)
    assert power.max() > 100


def test_shifts_of_blocks_are_drawn_if_significant(residuals):
    assert figures.significant_shifts(residuals) is None
    blocks = residuals.blocks.copy()
    blocks[..., GX_R] = 0.2 * blocks[..., GXX]
    places, shifts = figures.significant_shifts(replace(residuals, blocks=blocks))
    np.testing.assert_allclose(shifts, np.broadcast_to([0.2, 0], shifts.shape), atol=1e-12)
    np.testing.assert_allclose(places[0], (BLOCK_PX - 1) / 2)
    np.testing.assert_allclose(places[-1], [(480 + 495) / 2, (240 + 253) / 2])
    assert "0.2 px" in figures.over_sensor(replace(residuals, blocks=blocks))


def test_figures_draw_residuals_of_a_single_span_that_saw_nothing(residuals):
    nothing = replace(
        residuals,
        spans=residuals.spans[:1],
        instants=residuals.instants[:1],
        normal=0 * residuals.normal[:1],
        gradient=residuals.gradient[:1],
        blocks=0 * residuals.blocks,
        block_chi2=residuals.block_chi2 * np.nan,
        cell_chi2=residuals.cell_chi2 * np.nan,
        cell_count=0 * residuals.cell_count,
    )
    for svg in (
        figures.chi2_over_panorama(nothing, CANVAS, CANVAS),
        figures.over_sensor(nothing),
        figures.shifts_over_time(nothing, 100.0),
    ):
        ElementTree.fromstring(svg)
