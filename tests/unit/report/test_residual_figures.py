"""Views of poses in perspective, and the figures of the residuals."""

import re
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano.geometry import Canvas
from photonpano.report import figures
from photonpano.report.pose_page import path_views, scene_views
from photonpano.residuals.block_sums import BLOCK_PX, GX_R, GXX
from photonpano.values import PoseEstimate, ScenePoints

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


SHAPE, N_FRAMES = (90, 120), 60
MATRIX = np.array([[100.0, 0, 59.5], [0, 100, 44.5], [0, 0, 1]])


def facing_ahead(places: np.ndarray) -> np.ndarray:
    """Return poses (N, 3, 4) of cameras that look along z from places (N, 3)."""
    return np.concatenate([np.tile(np.eye(3), (len(places), 1, 1)), -places[:, :, None]], axis=2)


@pytest.fixture
def estimate_of() -> Callable[..., PoseEstimate]:
    """Make an estimate of a camera that moves to the right and rises, before points; some frames may be lost."""

    def estimate_of(lost: slice = slice(0), straight: bool = False, n_points: int = 200) -> PoseEstimate:
        times = np.linspace(0, 1, N_FRAMES)
        bend = 0 * times if straight else 0.1 * np.sin(5 * times)
        poses = facing_ahead(np.stack([times, bend, 0.3 * bend * times], axis=1))
        located = np.ones(N_FRAMES, bool)
        located[lost] = False
        poses[~located] = np.nan
        std = np.where(located, 0.01, np.nan)
        rng = np.random.default_rng(2)
        points = ScenePoints(
            rng.uniform([-1, -0.5, 2], [1, 0.5, 6], (n_points, 3)), rng.uniform(0, 1, n_points).astype(np.float32)
        )
        return PoseEstimate(MATRIX, np.zeros(4), 0.0, poses, located, std, std, points, (), (), ())

    return estimate_of


@pytest.mark.parametrize("straight", [False, True])
def test_views_name_their_ends_and_sides(estimate_of: Callable[..., PoseEstimate], straight: bool) -> None:
    estimate = estimate_of(lost=slice(50, None), straight=straight)
    for view in (*path_views(estimate, SHAPE), *scene_views(estimate, SHAPE)):
        texts = re.findall(r"<text[^>]*>([^<]*)</text>", view)
        assert {"frame 0", "frame 49"} <= set(texts)
        assert len([text for text in texts if text.startswith("from ")]) == 1
        assert not re.search(r"\b(nan|inf)\b", re.sub(r"base64,[^\"]*", "", view))
