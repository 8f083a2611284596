"""Summaries and pictures of captures."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, StreamInfo
from photonpano.capture import capture_of
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.summary import summarise
from photonpano.report.preview import Style, pictures, preview_spans, white_flux
from photonpano.testing import MemorySource

SHAPE = (96, 128)


class Film:
    """A source of a texture that moves, made when it is asked for; the x of its frames is a function of their indices.

    `front` stands before it.
    """

    def __init__(self, x_px: Any, n_frames: int, flux: float, contrast: float = 0.9, hot: bool = False) -> None:
        rng = np.random.default_rng(5)
        noise = cv2.GaussianBlur(rng.normal(0, 1, (SHAPE[0], 1500)), (0, 0), 3)
        self.scene = (flux * np.clip(1 + contrast * noise / (2 * noise.std()), 0.05, None)).astype(np.float32)
        self.info, self.response = StreamInfo(n_frames, *SHAPE, None), BinaryResponse()
        self.valid = np.ones(SHAPE, bool)
        self.hot = np.zeros(SHAPE, bool)
        if hot:
            self.hot = rng.random(SHAPE) < 0.02
            self.valid = ~self.hot
        self.x_px = x_px
        self.front = np.zeros((0, 0))

    def counts(self, span: FrameSpan) -> np.ndarray:
        counts = np.zeros(SHAPE, np.uint32)
        for frame in range(span.start, span.stop):
            shift = np.float32([[1, 0, -float(self.x_px(frame))], [0, 1, 0]])
            flux = cv2.warpAffine(self.scene, shift, SHAPE[::-1], borderMode=cv2.BORDER_REFLECT)
            height, width = self.front.shape
            flux[20 : 20 + height, 25 : 25 + width] = self.front
            lit = np.random.default_rng(frame).random(SHAPE) < -np.expm1(-flux)
            counts += lit | self.hot
        return counts


@pytest.mark.parametrize("speed_px", [0.05, 0.3, 2.0])
def test_summary_finds_the_speed_of_a_pan(speed_px: float) -> None:
    summary = summarise(Film(lambda frame: speed_px * frame, 400, 0.5))
    assert summary.speed_px == pytest.approx(speed_px, rel=0.1)
    assert summary.flux == pytest.approx(0.5, rel=0.1)


def test_summary_uses_longer_sums_in_the_dark() -> None:
    bright, dark = (summarise(Film(lambda frame: 0.5 * frame, 400, flux)) for flux in (1.0, 0.05))
    assert dark.speed_px == pytest.approx(0.5, rel=0.1)
    assert dark.flux == pytest.approx(0.05, rel=0.1)
    frames = [int(summary.how.split()[-2]) for summary in (bright, dark)]
    assert frames[0] < frames[1]


def test_summary_gives_the_speed_of_the_fast_part() -> None:
    def x_px(frame: int) -> float:
        return 0.1 * frame + 0.9 * max(0, frame - 280)  # 1 px a frame in the last third

    assert summarise(Film(x_px, 400, 0.5)).speed_px == pytest.approx(1.0, rel=0.1)


def test_summary_gives_the_speed_of_the_scene_behind_an_object_with_strong_contrast() -> None:
    """The object covers 30 % of the frame, and makes the highest peak of the correlation."""
    film = Film(lambda frame: 0.3 * frame, 400, 1.0, contrast=2.0)
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (56, 66)), (0, 0), 2)
    film.front = np.exp(1.5 * texture / texture.std()) / 3
    assert summarise(film).speed_px == pytest.approx(0.3, rel=0.35)


def test_summary_of_a_still_capture_is_slow() -> None:
    speed_px = summarise(Film(lambda _: 0, 200, 0.5)).speed_px
    assert speed_px is not None
    assert speed_px < 0.02


@pytest.mark.parametrize(("flux", "contrast"), [(1e-5, 0.9), (0.5, 0)])
def test_summary_has_no_speed_in_the_dark_or_without_texture(flux: float, contrast: float) -> None:
    summary = summarise(Film(lambda frame: 0.3 * frame, 200, flux, contrast))
    assert summary.speed_px is None
    assert summary.how == "no motion was found at any of 12 places"


def test_summary_ignores_masked_pixels() -> None:
    summary = summarise(Film(lambda frame: 0.3 * frame, 400, 0.1, hot=True))
    assert summary.speed_px == pytest.approx(0.3, rel=0.1)
    assert summary.flux == pytest.approx(0.1, rel=0.1)


def test_summary_does_not_depend_on_the_number_of_threads() -> None:
    film = Film(lambda frame: 0.3 * frame, 200, 0.1)
    assert summarise(film, threads=1) == summarise(film, threads=4)


def test_summary_of_few_frames_has_no_speed() -> None:
    summary = summarise(Film(lambda frame: frame, 20, 0.5))
    assert summary.speed_px is None
    assert summary.how == "20 frames are too few to estimate a motion"
    assert summary.flux == pytest.approx(0.5, rel=0.1)


def test_summary_uses_corrected_sums() -> None:
    frames = np.random.default_rng(0).random((120, *SHAPE)) < 0.1
    assert summarise(MemorySource(frames)).flux == pytest.approx(-np.log1p(-0.1), rel=0.02)
    veiled = replace(capture_of(MemorySource(frames)), steps=(lambda counts, _: counts.astype(np.float32) / 2,))
    assert summarise(veiled).flux == pytest.approx(-np.log1p(-0.05), rel=0.02)


UNLABELLED = Style(white_flux=1.0, label=False)


@pytest.fixture
def ramp() -> np.ndarray:
    """(600, 24, 40) frames of a scene from dark to nearly saturated."""
    flux = np.geomspace(0.01, 3, 40) * np.linspace(0.3, 1.2, 24)[:, None]
    return (np.random.default_rng(0).random((600, *flux.shape)) < -np.expm1(-flux)).astype(np.uint8)


@pytest.mark.parametrize(
    ("group_size", "step", "starts"),
    [(40, 40, [0, 40]), (40, 25, [0, 25, 50]), (100, 1, [0]), (50, 50, [0, 50]), (30, 50, [0, 50])],
)
def test_preview_spans_are_a_step_apart_within_the_capture(group_size: int, step: int, starts: list[int]) -> None:
    spans = preview_spans(StreamInfo(100, 4, 8, None), group_size, step)
    assert spans == [FrameSpan(start, start + group_size) for start in starts]


def test_short_capture_is_one_exposure() -> None:
    assert preview_spans(StreamInfo(30, 4, 8, None), 256, 256) == [FrameSpan(0, 30)]


def test_levels_are_the_flux_in_srgb(memory_source: type, ramp: np.ndarray) -> None:
    spans = [FrameSpan(0, 256), FrameSpan(300, 556)]
    found = list(pictures(memory_source(ramp), spans, UNLABELLED, threads=2))
    for span, picture in zip(spans, found, strict=True):
        share = ramp[span.start : span.stop].mean(axis=0)
        flux = np.clip(-np.log(np.maximum(1 - share, 1e-9)), 0, 1)
        encoded = np.where(flux <= 0.0031308, 12.92 * flux, 1.055 * flux ** (1 / 2.4) - 0.055)
        assert picture.dtype == np.uint8
        assert np.abs(picture - 255 * encoded).max() <= 0.51
    (linear,) = pictures(memory_source(ramp), spans[1:], Style(1.0, srgb=False, label=False))
    assert np.abs(linear - 255 * flux).max() <= 0.51


def test_white_flux_is_a_quantile_over_all_exposures(memory_source: type) -> None:
    frames = np.zeros((200, 10, 10), np.uint8)
    frames[100:200:2, :, :] = 1
    spans = preview_spans(StreamInfo(200, 10, 10, None), 100, 100)
    assert white_flux(memory_source(frames), spans, 1.0) == pytest.approx(np.log(2))
    assert white_flux(memory_source(frames), spans, 0.4) == 1.0
    assert white_flux(memory_source(0 * frames), spans, 1.0) == 1.0


def test_masked_pixels_are_black(memory_source: type) -> None:
    valid = np.ones((4, 6), bool)
    valid[1, 2] = False
    (picture,) = pictures(memory_source(np.ones((20, 4, 6)), valid), [FrameSpan(0, 20)], UNLABELLED)
    assert (picture == np.where(valid, 255, 0)).all()


def test_label_is_added_below_the_picture(memory_source: type, ramp: np.ndarray) -> None:
    source, spans = memory_source(ramp), [FrameSpan(0, 100), FrameSpan(500, 600)]
    plain, labelled = (list(pictures(source, spans, Style(1.0, label=label))) for label in (False, True))
    strips = [each[len(bare) :] for each, bare in zip(labelled, plain, strict=True)]
    for each, bare in zip(labelled, plain, strict=True):
        assert each.shape[1] == bare.shape[1]
        np.testing.assert_array_equal(each[: len(bare)], bare)
    assert all(strip.max() > 50 for strip in strips)
    assert (strips[0] != strips[1]).any()


PHOTONCUBE = """
import sys
from photoncube import PhotonCube
cube = PhotonCube.open(sys.argv[1])
cube.set_range(0, None, 128)
cube.save_images(sys.argv[2], invert_response=True, tonemap2srgb=sys.argv[3] == "srgb")
"""


@pytest.mark.parametrize("curve", ["srgb", "linear"])
def test_levels_equal_those_of_photoncube(tmp_path: Path, memory_source: type, ramp: np.ndarray, curve: str) -> None:
    """Which rounds down, takes the flux of 1 for white whatever its quantile says, and has no more frames than fit."""
    pytest.importorskip("photoncube")
    np.save(tmp_path / "cube.npy", np.packbits(ramp, axis=-1))
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    command = [sys.executable, "-c", PHOTONCUBE, tmp_path / "cube.npy", theirs, curve]
    subprocess.run(command, check=True, capture_output=True)
    files = sorted(theirs.iterdir())
    source = memory_source(ramp)
    ours = list(pictures(source, preview_spans(source.info, 128, 128), Style(1.0, srgb=curve == "srgb", label=False)))
    assert len(files) == len(ours) == 4
    for file, picture in zip(files, ours, strict=True):
        difference = picture - cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(int)
        assert set(np.unique(difference)) <= {0, 1}
