"""The figures of a page, and their pictures."""

import base64
import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from photonpano.geometry import Camera, Canvas, rotation_matrices, translation
from photonpano.report import figures
from photonpano.values import Light


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


def test_figures_use_colour_variables_of_page(motion, panorama):
    svgs = [
        figures.path_over_time(motion, 96_800.0),
        figures.path_on_panorama(motion, panorama),
        figures.coverage_map(panorama.thumbnail.weight),
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


def test_figures_draw_single_frame(small, panorama):
    single = replace(small, homographies=np.eye(3)[None], located=np.ones(1, bool), std_px=np.ones(1), reference=0)
    for svg in (figures.path_over_time(single, 100.0), figures.path_on_panorama(single, of_shape(panorama, (30, 90)))):
        ElementTree.fromstring(svg)


def test_path_of_full_turn_is_in_degrees_from_the_reference_frame(motion):
    yaws = np.radians(np.linspace(-200, 200, len(motion.homographies)))
    camera = Camera.of(330.0, motion.frame_shape)
    turns = rotation_matrices(np.stack([0 * yaws, yaws, 0 * yaws], axis=-1))
    turning = replace(motion, camera=camera, homographies=camera.homographies(turns), reference=len(yaws) // 2)
    path, unit = figures._path(turning, np.arange(len(yaws)))
    assert unit == "degrees"
    np.testing.assert_allclose(path[:, 0], np.degrees(yaws), atol=1e-6)


@pytest.mark.parametrize("depth", [0.4, 0.0])
def test_maps_show_where_lamps_flicker(depth):
    """Lamps light the left half of the scene; in the dark half there is no phase."""
    maps = np.zeros((2, 20, 40), np.float32)
    maps[0, :, :20] = depth
    light = Light(np.ones(8), np.ones((2, 8)), maps, np.eye(3), 0.1, np.zeros(8))
    svg = figures.flicker_over_panorama(light, Canvas(20, 40, np.eye(3)))
    flicker, phase = (
        cv2.imdecode(np.frombuffer(base64.b64decode(each), np.uint8), cv2.IMREAD_UNCHANGED).astype(float)
        for each in re.findall(r'data:image/png;base64,([^"]*)"', svg)
    )
    assert (flicker[..., 3] == 255).all()
    assert (np.ptp(flicker[:, :19], axis=(0, 1)) == 0).all()
    assert np.array_equal(flicker[5, 5], flicker[5, 35]) == (depth == 0)
    if depth:
        assert (phase[:, :19, 3] == 255).all()
        assert (phase[:, 21:, 3] == 0).all()
        assert f">{depth:g}</span>" in svg
