"""Summaries and pictures of captures."""

from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, StreamInfo
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.summary import summarise
from photonpano.report.preview import preview_spans

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
        self.frame = cache(self.made)  # spans overlap

    def made(self, frame: int) -> np.ndarray:
        shift = np.float32([[1, 0, -float(self.x_px(frame))], [0, 1, 0]])
        flux = cv2.warpAffine(self.scene, shift, SHAPE[::-1], borderMode=cv2.BORDER_REFLECT)
        height, width = self.front.shape
        flux[20 : 20 + height, 25 : 25 + width] = self.front
        return (np.random.default_rng(frame).random(SHAPE) < -np.expm1(-flux)) | self.hot

    def counts(self, span: FrameSpan) -> np.ndarray:
        return np.sum([self.frame(index) for index in range(span.start, span.stop)], axis=0, dtype=np.uint32)


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


def test_summary_gives_the_speed_of_the_scene_behind_an_object_with_strong_contrast() -> None:
    """The object covers 30 % of the frame, and makes the highest peak of the correlation."""
    film = Film(lambda frame: 0.3 * frame, 400, 1.0, contrast=2.0)
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (56, 66)), (0, 0), 2)
    film.front = np.exp(1.5 * texture / texture.std()) / 3
    assert summarise(film).speed_px == pytest.approx(0.3, rel=0.35)


@pytest.mark.parametrize(("flux", "contrast"), [(1e-5, 0.9), (0.5, 0)])
def test_summary_has_no_speed_in_the_dark_or_without_texture(flux: float, contrast: float) -> None:
    summary = summarise(Film(lambda frame: 0.3 * frame, 200, flux, contrast))
    assert summary.speed_px is None
    assert summary.how == "no motion was found at any of 12 places"


@pytest.mark.parametrize(
    ("group_size", "step", "starts"),
    [(40, 40, [0, 40]), (40, 25, [0, 25, 50]), (100, 1, [0]), (50, 50, [0, 50]), (30, 50, [0, 50])],
)
def test_preview_spans_are_a_step_apart_within_the_capture(group_size: int, step: int, starts: list[int]) -> None:
    spans = preview_spans(StreamInfo(100, 4, 8, None), group_size, step)
    assert spans == [FrameSpan(start, start + group_size) for start in starts]


def swaying(amplitude_px: float, period: float, flux: float, drift_px: float = 0.0, n_frames: int = 800) -> Film:
    return Film(lambda frame: 20 + drift_px * frame + amplitude_px * np.sin(2 * np.pi * frame / period), n_frames, flux)


@pytest.mark.parametrize(("period", "flux"), [(80.0, 0.05), (160.0, 0.05), (80.0, 0.3)])
def test_summary_finds_after_how_many_frames_an_image_that_returns_is_farthest(period: float, flux: float) -> None:
    """Sums of 80 frames or more, which are exact in the dark, average it away."""
    assert summarise(swaying(4.0, period, flux)).away_frames == pytest.approx(period / 2, rel=0.2)


@pytest.mark.parametrize(
    "film",
    [
        swaying(0, 80, 0.3),  # stands still
        swaying(0, 80, 0.02, drift_px=0.1),
        swaying(2, 80, 0.3, drift_px=0.2),  # moves on while it trembles
        swaying(0.5, 80, 0.3),  # within a pixel
        swaying(0, 80, 0.3, n_frames=20),
    ],
)
def test_an_image_that_stands_still_or_moves_on_does_not_return(film: Film) -> None:
    assert summarise(film).away_frames is None
