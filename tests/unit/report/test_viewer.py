import base64
import json
import re
import zlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import Group, VirtualExposure
from photonpano.capture import with_background
from photonpano.geometry import Canvas, canvas_around, translation
from photonpano.geometry.camera import Camera
from photonpano.geometry.canvas import PROJECTIONS, Covered
from photonpano.report import OpenCapture, render_report, viewer
from photonpano.testing import MemorySource
from photonpano.values import CELL_PX, Background


def decoded(linear: dict) -> np.ndarray:
    """Decode linear data as the script does."""
    planes = np.frombuffer(zlib.decompress(base64.b64decode(linear["data"])), np.uint8).reshape(2, -1).astype(int)
    codes = 256 * planes[0] + planes[1]
    flux = linear["low"] * (linear["high"] / linear["low"]) ** ((codes - 1) / (linear["codes"] - 1))
    shape = (linear["height"], linear["width"], linear["channels"])
    return np.where(codes > 0, flux, np.nan).reshape(shape)


@pytest.mark.parametrize("shape", [(30, 50), (30, 50, 3)])
def test_linear_data_keeps_flux_to_a_sixth_of_a_percent(shape):
    flux = np.exp(np.random.default_rng(0).uniform(-6, 3, shape)).astype(np.float32)
    flux[3, 4], flux[5, 6] = np.nan, 0
    found = decoded(viewer.linear_data(flux, 2.0)).reshape(shape)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(flux))
    assert np.all(found[5, 6] == pytest.approx(1e-5 * np.nanmax(flux)))
    flux[5, 6] = np.nan
    np.testing.assert_allclose(found[~np.isnan(flux)], flux[~np.isnan(flux)], rtol=1.6e-3)


def test_path_has_outlines_on_the_panorama(motion, panorama):
    path = viewer.path_data(motion, panorama)
    start = path["frames"][path["start"]]
    assert abs(start - motion.reference) <= 10
    assert path["frames"][0] == 0
    assert path["std"][0] is None
    outlines = np.array(path["outlines"])
    assert outlines.shape == (len(path["frames"]), 5, 2)
    assert not path["wide"]
    np.testing.assert_array_equal(outlines[:, 0], outlines[:, -1])
    height, width = panorama.canvas.shape
    assert outlines.min() > -1.5
    assert (outlines.max(axis=(0, 1)) < [width + 0.5, height + 0.5]).all()
    halved = viewer.path_data(motion, replace(panorama, reduction=2))
    np.testing.assert_allclose(np.array(halved["outlines"]), outlines, atol=1.1)


def test_shared_instant_is_near_an_exposure_of_each_level(motion):
    levels = [
        SimpleNamespace(located=SimpleNamespace(instants=np.array(instants)))
        for instants in ([1000.0, 5000.0, 9000.0], [1000.0, 3000.0, 4990.0, 7000.0, 9000.0])
    ]
    assert viewer.shared_instant(motion, levels) == 9000 or viewer.shared_instant(motion, levels) == 1000
    levels[1].located.instants[2] = 5000.0
    assert viewer.shared_instant(motion, levels) == 5000


def decoded_picture(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).astype(float)


def capture_of_a_person(hidden_cells: int) -> OpenCapture:
    """Frames of noise as large as those of the fixtures, of which some cells at the left hide the background."""
    shape, instant = (254, 496), 30.0
    source = MemorySource(np.random.default_rng(0).random((60, *shape)) < 0.5)
    shown = np.ones((1, *(-(-side // CELL_PX) for side in shape)), bool)
    shown[..., :hidden_cells] = False
    found = Background(np.array([instant]), shown, np.ones_like(shown), shape) if hidden_cells else None
    flux = np.ones(shape, np.float32)
    exposure = VirtualExposure(flux, flux, Group(source.info.span, instant), 1.0, source.response)
    solution = SimpleNamespace(located=np.array([True]))
    located = SimpleNamespace(instants=np.array([instant]), solution=solution)
    exposures = SimpleNamespace(merged=lambda _: exposure)
    level: Any = SimpleNamespace(level=SimpleNamespace(number=1), located=located, exposures=exposures)
    return OpenCapture(with_background(source, found), [level])


def test_pictures_of_frames_have_all_photons():
    capture = capture_of_a_person(31)
    found = viewer.glimpses(capture.source, 16, 1.0)
    assert {each["hidden"] for each in found} == {0.5}
    seen = decoded_picture(found[20]["uri"])
    assert seen[:, :100].mean() == pytest.approx(seen[:, 140:].mean(), rel=0.05)


def test_panoramas_wider_than_opencv_takes_show_what_a_frame_sees(motion, panorama):
    capture, dark = capture_of_a_person(0), replace(panorama, white_flux=5000.0)
    wide = replace(panorama.thumbnail, flux=np.pad(panorama.thumbnail.flux, ((0, 0), (0, 33_000)), constant_values=np.nan))
    canvas = replace(panorama.canvas, width=panorama.canvas.width + 33_000)
    shown = [
        viewer.views_of_instant(30, motion, each, capture.source, capture.levels)[-1]["uri"]
        for each in (dark, replace(dark, thumbnail=wide, canvas=canvas))
    ]
    assert shown[0] == shown[1]
    assert decoded_picture(shown[0]).std() > 10


TURN, SECTOR = (-np.pi, np.pi), (0.4, 1.1)


@pytest.mark.parametrize(("projection", "across"), [("spherical", TURN), ("spherical", SECTOR), ("mercator", TURN)])
def test_angles_are_those_of_the_directions_of_pixels(projection, across):
    camera = Camera(np.array([[90.0, 0, 80], [0, 90, 60], [0, 0, 1]]))
    canvas = canvas_around(Covered(across, (-0.6, 0.3)), camera, 1.0, projection)
    found = viewer.angles_of(canvas)
    assert found is not None
    assert found["projection"] == projection
    places = np.array([[0.0, 0.0], [canvas.width - 1.0, 3.0], [17.0, canvas.height - 1.0]])
    shares = (places + 0.5) / [canvas.width, canvas.height]
    low, high = np.transpose([found["across"], found["down"]])
    directions = canvas.on_plane(places) @ canvas.plane_to_rays.T
    np.testing.assert_allclose(low + shares * (high - low), PROJECTIONS[projection].points(directions), atol=1e-9)


def test_page_looks_around_on_a_sphere_only(record, explained, panorama):
    height, width = panorama.canvas.shape
    matrix = np.array([[300.0, 0, 247.5], [0, 300, 126.5], [0, 0, 1]])
    transform = translation((width - 1) / 2, (height - 1) / 2) @ np.diag([300.0, 300, 1])
    around = Canvas(height, width, transform, "spherical", matrix)
    capture = capture_of_a_person(0)
    pages = [
        render_report(record, explained, replace(panorama, canvas=canvas), capture=capture)
        for canvas in (panorama.canvas, around, replace(around, projection="cylindrical"))
    ]
    assert ["function sphereViewer" in page for page in pages] == [False, True, False]
    assert ['"angles": null' in page for page in pages] == [True, False, True]
    data = json.loads(re.findall(r'id="viewer-data">(.*?)</script>', pages[1], re.DOTALL)[0])
    side = width / 600
    assert data["angles"]["across"] == pytest.approx([-side, side])
    assert data["angles"]["down"] == pytest.approx([-height / 600, height / 600])
    assert pages[1].count("data:image/") <= pages[0].count("data:image/")  # it shows the picture that is there
