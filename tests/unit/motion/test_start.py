"""The speed of the image from short spans: small captures of 64x96 px in memory, whose motion is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group
from photonpano.context import Context
from photonpano.motion.start import StartingMotion, starting_motion

SHAPE = (64, 96)
LENGTH = 32
"""Frames of a group."""


def tiled(period: int) -> np.ndarray:
    """Panels that repeat every `period` px along both sides: (64, 800) of flux."""
    rng = np.random.default_rng(1)
    return np.tile(rng.uniform(0.05, 0.6, (period // 4, period // 4)).repeat(4, 0).repeat(4, 1), (4, 60))[:64, :800]


@pytest.fixture
def started(memory_source: type) -> Callable[..., StartingMotion | None]:
    """Simulate a pan over a scene in steps of a px, behind what stands in front, and measure its start."""

    def started(scene: np.ndarray, px_per_frame: float, n_frames: int = 128, front: np.ndarray | None = None) -> Any:
        rng = np.random.default_rng(0)
        views = [scene[:, int(px_per_frame * frame) :][:, : SHAPE[1]] for frame in range(n_frames)]
        if front is not None:
            views = [np.where(np.isnan(front), view, front) for view in views]
        source = memory_source([rng.random(SHAPE) < -np.expm1(-view) for view in views])
        length = LENGTH if front is None else 2 * LENGTH
        spans = [FrameSpan(start, start + length) for start in range(0, n_frames, length)]
        return starting_motion(source, [Group(span, span.centre) for span in spans], Context())

    return started


def test_speed_is_right_where_groups_move_by_more_than_a_panel(started: Callable) -> None:
    """A group moves by 64 px, so that panels of 40 px fit a shift of -16 px between groups better than the true one."""
    start = started(tiled(40), 2)
    shift = start.between(80.0, 48.0)[:2, 2]
    np.testing.assert_allclose(shift, [64, 0], atol=2)
    assert start.alternative_px(80.0, 48.0) == 0


def test_slower_motion_is_taken_and_the_other_named_where_spans_move_by_half_a_panel(started: Callable) -> None:
    """Spans of 4 frames move by 8 px, so that panels of 20 px fit a motion back by 12 px as well."""
    start = started(tiled(20), 2)
    np.testing.assert_allclose(start.between(80.0, 48.0)[:2, 2], [64, 0], atol=6)
    assert start.alternative_px(80.0, 48.0) == pytest.approx(32 / 4 * 20, abs=8)


def textured(shape: tuple[int, int], contrast: float, seed: int) -> np.ndarray:
    """Flux of texture without a period."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), 2)
    return 0.8 * np.exp(contrast * noise / noise.std())


def test_start_follows_the_scene_and_not_an_object_with_strong_contrast(started: Callable) -> None:
    """Most of the image counts, and not the highest peak of the correlation, which is that of the object."""
    front = np.full(SHAPE, np.nan)
    front[16:44, 26:70] = textured((28, 44), 1.0, 2)  # 20 % of the frame
    start = started(textured((64, 800), 1.0, 1), 0.25, 256, front)
    np.testing.assert_allclose(start.velocities, np.tile([-0.25, 0.0], (len(start.velocities), 1)), atol=0.1)
    assert start.alternative_px(80.0, 48.0) == 0


def test_motion_is_unknown_beyond_the_windows_with_a_significant_peak(started: Callable) -> None:
    scene = tiled(40)
    scene[:, 2 * 96 :] = 0.3
    start = started(scene, 2, n_frames=256)
    assert start.between(64.0, 32.0) is not None
    assert start.between(250.0, 220.0) is None


def test_no_motion_is_known_without_texture(started: Callable) -> None:
    assert started(np.full((64, 800), 0.3), 2) is None
