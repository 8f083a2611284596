"""The first and the last frame that saw each pixel of a canvas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photonpano import FrameSpan
from photonpano.capture import MaskedSpan, capture_of
from photonpano.geometry import Canvas, canvas_of, translation
from photonpano.merging.seen_frames import NEVER, seen_frames
from photonpano.testing.captures import KnownMotion, MemorySource
from photonpano.values import Light

SHAPE, N_FRAMES = (20, 30), 60
PAN = KnownMotion(lambda frame: translation(float(frame), 0))  # a pixel to the right in each frame
SPAN = FrameSpan(0, N_FRAMES)
CANVAS = canvas_of(PAN.at(np.arange(N_FRAMES)), SHAPE, 1.0)


def seen(source: object, canvas: Canvas = CANVAS, span: FrameSpan = SPAN) -> tuple[np.ndarray, np.ndarray]:
    first, last = seen_frames(source, PAN, span, canvas)
    return first, last


def source(valid: np.ndarray | None = None) -> MemorySource:
    return MemorySource(np.zeros((N_FRAMES, *SHAPE)), valid)


def test_a_pan_sees_a_column_while_it_is_in_the_frame() -> None:
    """The last column of the frame comes first, and the first one last."""
    first, last = seen(source())
    columns = np.arange(CANVAS.width)
    expected = np.clip(columns - SHAPE[1] + 1, 0, N_FRAMES), np.clip(columns, 0, N_FRAMES - 1)
    for found, right in zip((first, last), expected, strict=True):
        inner = found[2:-2, 2:-2].astype(int)
        assert abs(inner - right[2:-2]).max() <= 1  # frames within a pixel of motion count as one


def test_places_beside_the_frames_were_never_seen() -> None:
    first, last = seen(source(), CANVAS.part(-40, 0, 20, 30))
    assert (first == NEVER).all()
    assert (last == NEVER).all()


def test_dark_frames_saw_nothing() -> None:
    gain = np.where(np.arange(N_FRAMES) < 10, 0.0, 1.0)
    lit = Light.of_frames(gain, std=np.where(gain > 0, 0.0, np.inf))
    first, _ = seen(replace(capture_of(source()), light=lit))
    assert first.min() == 10


def test_masked_pixels_saw_nothing() -> None:
    """The right half of the sensor is masked, and the left half in the first frames."""
    valid = np.ones(SHAPE, dtype=bool)
    valid[:, 15:] = False
    hand = MaskedSpan(FrameSpan(0, 20), np.zeros(SHAPE, dtype=bool))
    first, last = seen(replace(capture_of(source(valid)), masks=(hand,)))
    assert first[10, 30] == 20  # 15 without the hand, and 1 without the mask
    assert last[10, 30] in (29, 30)
