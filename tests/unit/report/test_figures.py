"""The figures of a page, and their pictures."""

import base64
import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from photonpano.geometry import Camera, rotation_matrices, translation
from photonpano.report import figures
from photonpano.report.drawing import jpeg_uri, shrunk


@pytest.fixture
def small(motion):
    """Return two hundred frames that move 3 px to the right and 1 px down each."""
    frame = np.arange(200)
    return replace(
        motion,
        homographies=np.array([translation(3.0 * (t - 100), 1.0 * (t - 100)) for t in frame]),
        located=frame >= 20,
        reference=100,
    )


def of_shape(panorama, shape):
    return replace(panorama, picture=np.full(shape, 128, np.uint8))


def lines(svg: str, colour: str) -> list[np.ndarray]:
    """Return the vertices of the lines of one colour, in points of the drawing."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*style="fill: none; stroke: {re.escape(colour)};', svg)
    return [np.array(re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", path), dtype=float) for path in paths]


def test_figures_use_colour_variables_of_page(record, motion, panorama):
    svgs = [
        figures.path_over_time(motion, 96_800.0),
        figures.path_on_panorama(motion, panorama),
        figures.coverage_map(panorama.thumbnail.weight),
        figures.stage_times(record["levels"], record["panorama"]),
    ]
    for svg in svgs:
        ElementTree.fromstring(svg)
        assert "#0101" not in svg
        assert "#0102" not in svg
        assert not re.search(r"(stroke|fill): #000000", svg)
        assert "var(--" in svg


def test_path_over_time_of_pan_is_straight_at_constant_speed(small):
    svg = figures.path_over_time(small, None)
    [x], [y], [speed] = (lines(svg, f"var(--series-{number})") for number in (1, 2, 3))
    slope = (x[-1, 1] - x[0, 1]) / (x[-1, 0] - x[0, 0])
    assert slope / ((y[-1, 1] - y[0, 1]) / (y[-1, 0] - y[0, 0])) == pytest.approx(3, rel=1e-3)
    assert np.ptp(speed[:, 1]) < 1e-3


def test_path_over_time_bounds_number_of_points(motion):
    # Points that lie on the line between others would be left out of the drawing.
    with mpl.rc_context({"path.simplify": False}):
        svg = figures.path_over_time(motion, 96_800.0)
    assert figures.MAX_INSTANTS / 2 < len(lines(svg, "var(--series-1)")[0]) <= figures.MAX_INSTANTS


def test_path_over_time_shades_frames_not_located(small):
    shaded = '<path d="[^"]*"[^>]*style="fill: var\\(--muted\\); opacity: 0.18'
    assert len(re.findall(shaded, figures.path_over_time(small, None))) == 3
    assert not re.findall(shaded, figures.path_over_time(replace(small, located=np.ones(200, bool)), None))


@pytest.mark.parametrize(("rate", "label"), [(1000.0, "time (ms)"), (20.0, "time (s)")])
def test_time_axis_chooses_unit(small, rate, label):
    assert label in figures.path_over_time(small, rate)


def test_figures_draw_single_frame(small, panorama):
    single = replace(small, homographies=np.eye(3)[None], located=np.ones(1, bool), std_px=np.ones(1), reference=0)
    for svg in (figures.path_over_time(single, 100.0), figures.path_on_panorama(single, of_shape(panorama, (30, 90)))):
        ElementTree.fromstring(svg)


@pytest.mark.parametrize("shape", [(20, 9000), (3000, 20), (1, 1)])
def test_maps_draw_any_aspect_ratio(small, panorama, shape):
    drawings = figures.path_on_panorama(small, of_shape(panorama, shape)), figures.coverage_map(np.zeros(shape, np.float32))
    for svg in drawings:
        _, _, width, height = map(float, re.search(r'viewBox="([^"]*)"', svg).group(1).split())
        assert 90 < width <= 721
        assert 90 < height <= 430


def test_stage_times_bars_match_seconds(record):
    levels, panorama = record["levels"], record["panorama"]
    svg = figures.stage_times(levels, panorama)
    bars = {}
    for colour in ("var(--series-3)", "var(--series-5)"):  # locate, render
        paths = re.findall(rf'<path d="([^"]*)" [^>]*style="fill: {re.escape(colour)}"', svg)
        bars[colour] = [np.ptp([float(x) for x in re.findall(r"[ML] ([-\d.]+) ", path)]) for path in paths]
    located = bars["var(--series-3)"][:3]
    np.testing.assert_allclose(np.array(located) / located[0], np.array([40, 79, 157]) / 40, rtol=1e-4)
    assert bars["var(--series-5)"][0] / located[0] == pytest.approx(4.18 / 9.3, rel=1e-4)


def test_path_of_full_turn_is_in_degrees_from_the_reference_frame(motion):
    yaws = np.radians(np.linspace(-200, 200, len(motion.homographies)))
    camera = Camera.of(330.0, motion.frame_shape)
    turns = rotation_matrices(np.stack([0 * yaws, yaws, 0 * yaws], axis=-1))
    turning = replace(motion, camera=camera, homographies=camera.homographies(turns), reference=len(yaws) // 2)
    path, unit = figures._path(turning, np.arange(len(yaws)))
    assert unit == "degrees"
    np.testing.assert_allclose(path[:, 0], np.degrees(yaws), atol=1e-6)


def test_path_is_cut_where_it_crosses_the_seam():
    path = np.array([[80.0, 5], [95, 5], [3, 5], [10, 5]])
    cut = figures._cut_at_seam(path, 100)
    assert np.isnan(cut[2]).all()
    np.testing.assert_array_equal(np.delete(cut, 2, axis=0), path)


def decoded(uri: str) -> np.ndarray:
    head, content = uri.split(",")
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(content), np.uint8), cv2.IMREAD_UNCHANGED)


def test_jpeg_uri_keeps_grey_picture():
    image = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    np.testing.assert_allclose(decoded(jpeg_uri(image)), image, atol=4)


def test_jpeg_uri_keeps_order_of_colours():
    image = np.zeros((32, 32, 3), np.uint8)
    image[..., 0] = 220
    blue, green, red = decoded(jpeg_uri(image)).reshape(-1, 3).mean(axis=0)
    assert red > 210
    assert max(blue, green) < 15


@pytest.mark.parametrize(
    ("shape", "expected"), [((100, 400), (50, 200)), ((400, 100), (200, 50)), ((120, 80), (120, 80)), ((1, 5000), (1, 200))]
)
def test_shrunk_bounds_longer_side(shape, expected):
    assert shrunk(np.zeros(shape, np.uint8), 200).shape == expected


def test_shrunk_averages_pixels():
    image = np.indices((100, 400)).sum(axis=0) % 2 * np.float32(100)
    np.testing.assert_allclose(shrunk(image, 200), 50)
