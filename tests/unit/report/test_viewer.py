import base64
import re
import zlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import photonpano.report
from photonpano import FrameSpan, Group, Panorama, StreamInfo, VirtualExposure
from photonpano.capture import in_light, with_background
from photonpano.geometry import Canvas, rescaling, translation
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.photometry import BinaryResponse
from photonpano.report import OpenCapture, render_report, viewer
from photonpano.report.preview import still_exposure
from photonpano.testing import KnownMotion, MemorySource
from photonpano.values import CELL_PX, Background, Light

SCRIPT = Path(photonpano.report.__file__).parent / "templates" / "viewer.js"
RANGE = DynamicRange(CanvasNoise(BinaryResponse()))


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


def test_linear_data_of_a_large_panorama_is_reduced_over_what_was_seen(monkeypatch):
    monkeypatch.setattr(viewer, "LINEAR_VALUES", 600)
    flux = np.full((40, 60), 0.5, np.float32)
    flux[:, 31:] = np.nan
    found = decoded(viewer.linear_data(flux, 1.0))[..., 0]
    assert found.shape == (20, 30)
    np.testing.assert_allclose(found[:, :15], 0.5, rtol=1e-3)
    assert np.isnan(found[:, 16:]).all()


@pytest.mark.parametrize("flux", [np.full((4, 5), np.nan, np.float32), np.zeros((4, 5), np.float32)])
def test_linear_data_of_darkness_is_finite(flux):
    found = viewer.linear_data(flux, 1.0)
    assert 0 < found["low"] < found["high"] < np.inf


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


def test_maps_are_transparent_where_nothing_was_seen(panorama):
    coverage, uncertainty = viewer.panorama_maps(panorama)
    weight = panorama.thumbnail.weight
    assert coverage["low"] == 0
    assert coverage["high"] == pytest.approx(np.quantile(weight[weight > 0], 0.99), rel=1e-3)
    assert uncertainty["unit"].startswith("% of the flux")
    assert coverage["box"] == [0, 0, panorama.canvas.width, panorama.canvas.height]


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


@pytest.mark.parametrize("instant", [10.0, 12.5])
def test_views_of_an_instant_show_one_place(instant):
    """A scene that moves by 3 px a frame; the exposure is at half the size of a frame, and of a nearby instant."""
    scene = cv2.GaussianBlur(np.random.default_rng(0).random((80, 160)), (0, 0), 3).astype(np.float32)
    scene = (scene - scene.min()) / np.ptp(scene)
    shape, n_frames, here = (40, 64), 20, 11
    homographies = np.array([translation(3.0 * k, k) for k in range(n_frames)])

    def seen(place: float, scale: float) -> np.ndarray:
        size = round(shape[1] * scale), round(shape[0] * scale)
        to_scene = translation(3.0 * place, place) @ rescaling(1 / scale)
        return cv2.warpPerspective(scene, to_scene, size, flags=cv2.WARP_INVERSE_MAP | cv2.INTER_LINEAR)

    class Source:
        info = StreamInfo(n_frames, *shape, None)
        response = BinaryResponse()

    flux = seen(instant, 0.5)
    exposure = VirtualExposure(flux, np.ones_like(flux), Group(FrameSpan(0, 20), instant), 0.5, Source.response)
    level = SimpleNamespace(
        level=SimpleNamespace(number=1),
        located=SimpleNamespace(instants=np.array([instant]), solution=SimpleNamespace(located=np.array([True]))),
        exposures=SimpleNamespace(merged=lambda _: exposure),
    )
    located, trajectory = np.ones(n_frames, bool), KnownMotion(lambda k: translation(3.0 * k, k))
    motion = FrameMotion(trajectory, FrameSpan(0, n_frames), homographies, located, np.zeros(n_frames), 0, shape)
    canvas = Canvas(80, 160, np.eye(3))
    whole = Panorama(scene, np.ones_like(scene), np.eye(3))
    rendered = RenderedPanorama(canvas, whole, 1, np.zeros((80, 160), np.uint8), 1.0, 1.0, 0.1, 0.1 * scene, RANGE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(viewer, "still_exposure", lambda _, span: seen(span.start, 1.0))
        views = viewer.views_of_instant(here, motion, rendered, Source, [level])
    assert [view["name"] for view in views] == ["One frame", "Plain average", "Level 1", "Panorama"]
    frame, _, level_view, panorama = (decoded_picture(view["uri"])[8:-8, 8:-8] for view in views)
    assert np.corrcoef(frame.ravel(), panorama.ravel())[0, 1] > 0.97
    assert np.corrcoef(level_view.ravel(), panorama.ravel())[0, 1] > 0.97


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


def test_frame_in_dim_light_is_seen_by_itself():
    source = in_light(MemorySource(np.ones((4, 20, 30), bool)), Light.of_frames(np.array([1.2, 0.5, 1.1, 1.2])))
    assert np.isfinite(still_exposure(source, FrameSpan(1, 2))).all()


@pytest.mark.parametrize(("hidden_cells", "width"), [(31, 1400), (31, 400), (0, 1400)])
def test_hidden_parts_are_tinted_if_there_are_any(
    browser_page: Any, record, explained, panorama, tmp_path: Path, hidden_cells: int, width: int
):
    path = tmp_path / "report.html"
    path.write_text(render_report(record, explained, panorama, capture=capture_of_a_person(hidden_cells)), encoding="utf-8")
    browser_page.open(path, width)
    browser_page.wait_for('document.querySelector("#viewer.live")')
    text = browser_page.run("document.querySelector('.scrubber').textContent")
    assert re.findall(r"hidden parts: (\d+) % of this picture", text) == (["50"] if hidden_cells else [])
    boxes = """[...document.querySelectorAll('.seen img')].map(
      (each) => (({x, y, width, height}) => [x, y, width, height])(each.getBoundingClientRect()))"""
    browser_page.wait_for("[...document.querySelectorAll('.seen img')].every((each) => each.complete)")
    picture, *tints = browser_page.run(boxes)
    assert tints == ([picture] if hidden_cells else [])
    assert browser_page.run("document.documentElement.scrollWidth") == width
    if hidden_cells:
        browser_page.run("document.querySelector('.hidden-parts').click()")
        assert browser_page.run(boxes)[1] == [0, 0, 0, 0]
    assert (browser_page.messages, browser_page.requests) == ([], [])


def test_script_can_stand_in_a_page():
    text = SCRIPT.read_text(encoding="utf-8")
    assert not any(end in text for end in ("]]>", "</script", "{{", "{%", "{#", "http"))
