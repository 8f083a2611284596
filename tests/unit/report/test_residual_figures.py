"""Views of poses in perspective, and the figures of the residuals."""

import re
from collections.abc import Callable
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from photonpano.geometry import Canvas, transform_points
from photonpano.report import figures
from photonpano.report.pose_page import path_views, scene_views, viewpoints
from photonpano.residuals.block_sums import BLOCK_PX, GX_R, GXX
from photonpano.values import Light, PoseEstimate, ScenePoints

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


def test_light_is_drawn_only_if_it_changes(residuals):
    assert figures.light_over_time(residuals) is None
    svg = figures.light_over_time(replace(residuals, light=np.linspace(0.5, 1.5, len(residuals.spans))))
    ElementTree.fromstring(svg)
    assert "light / mean" in svg


def test_flicker_is_drawn_only_where_places_have_their_own():
    gain = np.ones(100)
    assert figures.flicker_over_panorama(None, Canvas(60, 90, np.eye(3))) is None
    assert figures.flicker_over_panorama(Light.of_frames(gain), Canvas(60, 90, np.eye(3))) is None
    waves, maps = np.zeros((2, 100)), np.stack([np.linspace(0, 0.8, 90 * 60).reshape(60, 90)] * 2).astype(np.float32)
    svg = figures.flicker_over_panorama(Light(gain, waves, maps, np.eye(3), 0.1, gain), Canvas(60, 90, np.eye(3)))
    ElementTree.fromstring(svg)
    assert "flicker / mean light" in svg
    assert "phase (degrees)" in svg


def test_flicker_of_large_panorama_is_that_of_the_middles_of_its_squares(monkeypatch):
    asked = []

    def even(_: Light, canvas: Canvas) -> list[np.ndarray]:
        asked.append(canvas)
        return [np.ones(canvas.shape)] * 2

    monkeypatch.setattr(figures, "amplitudes_on", even)
    light = Light(np.ones(9), np.zeros((2, 9)), np.zeros((2, 3, 3), np.float32), np.eye(3), 0.1, np.ones(9))
    figures.flicker_over_panorama(light, Canvas(500, 1000, np.eye(3)))
    assert asked[0].shape == (100, 200)
    np.testing.assert_allclose(transform_points(asked[0].transform, [[2.0, 2.0]]), [[0, 0]], atol=1e-12)


def test_spectrum_of_noise_is_one(residuals):
    frequencies, power = figures.spectrum_over_noise(residuals)
    assert (len(frequencies), frequencies[-1]) == (len(power), pytest.approx(1 / 32, rel=0.01))
    # Interpolation is expected to add 0.015 px to a noise of 0.03 px.
    assert power.mean() == pytest.approx(1 / (1 + 0.015**2 / 0.03**2), rel=0.1)


def test_spectrum_peaks_at_period_of_tremor(tremor):
    frequencies, power = figures.spectrum_over_noise(tremor)
    assert 1 / frequencies[power.argmax()] == pytest.approx(100, rel=0.02)
    assert power.max() > 100


def test_spectrum_ignores_spans_without_information(tremor):
    normal = tremor.normal.copy()
    normal[::7] = 0
    frequencies, power = figures.spectrum_over_noise(replace(tremor, normal=normal))
    assert 1 / frequencies[power.argmax()] == pytest.approx(100, rel=0.02)


@pytest.mark.parametrize(("rate", "label"), [(None, "cycles per frame"), (96_800.0, "frequency (Hz)")])
def test_spectrum_names_its_unit(residuals, rate, label):
    assert label in figures.shifts_over_time(residuals, rate)


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


def test_viewpoints_are_above_and_behind_what_is_wide_and_deep() -> None:
    rng = np.random.default_rng(1)
    shown = rng.normal(0, [3, 0.2, 1], (400, 3))
    above, behind = viewpoints(shown, facing_ahead(shown[:5]))
    assert (above.name, behind.name) == ("from above", "from behind")
    for each in (above, behind):
        np.testing.assert_allclose(each.axes @ each.axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(each.axes) == pytest.approx(1)
        assert each.axes[0] @ [1, 0, 0] > 0.9, "x points to the right"
    ahead, down = above.axes @ [0, 0, 1], behind.axes @ [0, 1, 0]
    assert ahead[1] > 0.8, "from above, what is ahead is up"
    assert down[1] < -0.8


def test_far_things_look_smaller_and_what_is_behind_the_viewer_is_left_out() -> None:
    shown = np.random.default_rng(1).normal(0, [3, 0.2, 1], (400, 3))
    view, _ = viewpoints(shown, facing_ahead(shown[:5]))
    right, _, towards = view.axes
    places = view.middle + np.array([right, right - 2 * towards, right + 2 * towards, right + 2 * view.distance * towards])
    seen, larger = view.project(places)
    assert seen[0].tolist() == pytest.approx([1, 0])
    assert seen[1, 0] == pytest.approx(view.distance / (view.distance + 2))
    assert seen[2, 0] == pytest.approx(view.distance / (view.distance - 2)) == pytest.approx(larger[2])
    assert np.isnan(seen[3]).all()


@pytest.mark.parametrize("straight", [False, True])
def test_views_name_their_ends_and_sides(estimate_of: Callable[..., PoseEstimate], straight: bool) -> None:
    estimate = estimate_of(lost=slice(50, None), straight=straight)
    for view in (*path_views(estimate, SHAPE), *scene_views(estimate, SHAPE)):
        texts = re.findall(r"<text[^>]*>([^<]*)</text>", view)
        assert {"frame 0", "frame 49"} <= set(texts)
        assert len([text for text in texts if text.startswith("from ")]) == 1
        assert not re.search(r"\b(nan|inf)\b", re.sub(r"base64,[^\"]*", "", view))


def test_lost_frames_are_a_gap_in_the_path(estimate_of: Callable[..., PoseEstimate]) -> None:
    whole, torn = (path_views(estimate_of(lost=lost), SHAPE)[0] for lost in (slice(0), slice(20, 30)))
    # Each step of the path is a shape, and so is each edge of a frustum; 10 lost frames are 11 steps.
    assert whole.count("<path") - torn.count("<path") == 11


def test_size_of_a_view_does_not_grow_with_the_points(estimate_of: Callable[..., PoseEstimate]) -> None:
    few, many = (len(scene_views(estimate_of(n_points=number), SHAPE)[0]) for number in (200, 50_000))
    assert many < 6 * few
