"""The smooth path of a camera: an even pan is followed exactly, tremor is left out, and a turn goes all the way round."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import Camera, FrameTrajectory, corner_displacements, rotation_matrices, translation
from photonpano.motion.frame_motion import FrameMotion, smooth_view

SHAPE = (96, 128)


def motion_of(homographies: np.ndarray, camera: Camera | None = None) -> FrameMotion:
    n_frames = len(homographies)
    located, std_px = np.ones(n_frames, bool), np.zeros(n_frames)
    return FrameMotion(FrameTrajectory(homographies), FrameSpan(0, n_frames), homographies, located, std_px, 0, SHAPE, camera)


def pan(tremor_px: float = 0.0, n_frames: int = 1200) -> np.ndarray:
    frames = np.arange(n_frames)
    return np.array([translation(0.2 * t + tremor_px * np.sin(t / 7), 0.1 * t) for t in frames])


def distance_px(motion: FrameMotion, instant: float, expected: np.ndarray) -> float:
    change = np.linalg.inv(expected) @ smooth_view(motion, instant, 150)
    return float(corner_displacements(change / change[2, 2], np.eye(3), SHAPE).max())


@pytest.mark.parametrize("instant", [0.0, 20.5, 600.0, 1199.0])
def test_even_pan_is_followed_without_lag(instant: float) -> None:
    homographies = pan()
    motion = motion_of(homographies)
    assert distance_px(motion, instant, motion.trajectory.at([instant])[0]) < 1e-4


def test_tremor_is_left_out() -> None:
    motion, even = motion_of(pan(tremor_px=3)), pan()
    assert max(distance_px(motion, instant, even[instant]) for instant in range(200, 1000, 37)) < 0.05


def test_turn_all_the_way_round_is_followed() -> None:
    angles = np.linspace(0, 2 * np.pi, 1200)
    camera = Camera.of(100, SHAPE)
    homographies = camera.homographies(rotation_matrices(np.stack([0 * angles, angles, 0 * angles], axis=-1)))
    motion = motion_of(homographies, camera)
    for instant in (0, 300, 600, 1199):  # ahead, to the side, backwards
        assert distance_px(motion, instant, homographies[instant]) < 1e-6


def test_single_frame_has_its_own_view() -> None:
    motion = motion_of(np.eye(3)[None])
    np.testing.assert_array_equal(smooth_view(motion, 0, 10), np.eye(3))
