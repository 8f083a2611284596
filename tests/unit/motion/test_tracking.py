"""Motion without exposures: the speed from short spans, and a constant velocity from all frames together."""

import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.geometry import (
    Camera,
    FrameTrajectory,
    corner_displacements,
    inverse,
    rotation_matrices,
    transform_points,
    translation,
)
from photonpano.motion.frame_motion import FrameMotion, smooth_view
from photonpano.motion.tracking import StartingMotion, starting_motion
from photonpano.motion.velocity import ConstantVelocity, FoundVelocity, Velocity, find_velocity
from photonpano.testing.captures import detected, seen_along, textured

SHAPE = (64, 96)
LENGTH = 32  # frames of a group


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


def uneven(shape: tuple[int, int], seed: int) -> np.ndarray:
    """Flux of texture without a period, and of strong contrast."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(0, 1, shape), (0, 0), 2)
    return 0.8 * np.exp(noise / noise.std())


def test_start_follows_the_scene_and_not_an_object_with_strong_contrast(started: Callable) -> None:
    """Most of the image counts, and not the highest peak of the correlation, which is that of the object."""
    front = np.full(SHAPE, np.nan)
    front[16:44, 26:70] = uneven((28, 44), 2)  # 20 % of the frame
    start = started(uneven((64, 800), 1), 0.25, 256, front)
    np.testing.assert_allclose(start.velocities, np.tile([-0.25, 0.0], (len(start.velocities), 1)), atol=0.1)
    assert start.alternative_px(80.0, 48.0) == 0


def test_motion_is_unknown_beyond_the_windows_with_a_significant_peak_and_without_texture(started: Callable) -> None:
    scene = tiled(40)
    scene[:, 2 * 96 :] = 0.3
    start = started(scene, 2, n_frames=256)
    assert start.between(64.0, 32.0) is not None
    assert start.between(250.0, 220.0) is None
    assert started(np.full((64, 800), 0.3), 2) is None


MIDDLE = np.array([47.5, 31.5])
CENTRE = np.array([60.0, 27.0])


def turning(degrees: float, centre: np.ndarray = CENTRE) -> Velocity:
    x, y = MIDDLE - centre
    return Velocity(np.radians(degrees), np.radians(degrees) * np.array([-y, x]), MIDDLE)


TURN, SHIFT, STILL = turning(-3.6), Velocity(0.0, np.array([0.6, -0.2]), MIDDLE), Velocity(0.0, np.zeros(2), MIDDLE)


@pytest.fixture
def captured(memory_source: type) -> Callable[..., Any]:
    """Simulate a textured scene that moves behind light that stands still."""

    def captured(motions: np.ndarray, flux: float, contrast: float = 0.8, seed: int = 0, flicker: float = 0.0) -> Any:
        height, width = SHAPE
        scene = textured((3 * height, 3 * width), flux, contrast, seed)
        views = seen_along(scene, translation(width, height) @ np.linalg.inv(motions), SHAPE)
        brightness = 1 + flicker * np.sin(2.1 * np.arange(len(motions)))
        return memory_source(detected(views * np.linspace(0.3, 1.7, width) * brightness[:, None, None], seed))

    return captured


def around(velocity: Velocity, n_frames: int) -> np.ndarray:
    return velocity.after(np.arange(n_frames) - n_frames // 2)


def found(source: Any) -> FoundVelocity:
    return find_velocity(source, Context(threads=1))


def test_velocity_leaves_the_centre_where_it_is_adds_up_and_maps_frames_to_the_reference() -> None:
    once, twice = TURN.after([3.0, 6.0])
    np.testing.assert_allclose(TURN.centre, CENTRE)
    np.testing.assert_allclose(transform_points(once, CENTRE[None])[0], CENTRE)
    np.testing.assert_allclose(once @ once, twice, atol=1e-9)
    np.testing.assert_allclose(SHIFT.after([5.0])[0][:2, 2], [3, -1])
    trajectory = ConstantVelocity(TURN, 10)
    np.testing.assert_allclose(trajectory.at([10])[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(inverse(trajectory.at([14.5]))[0], TURN.after([4.5])[0])


def test_turn_about_an_unknown_centre_is_found_at_3_photons_in_100_frames(captured: Callable) -> None:
    """Each frame has 180 photons, and turns by half a circle before 50 of them are taken."""
    start = found(captured(around(TURN, 96), 0.03))
    assert start.std_turn < np.radians(0.01)
    assert abs(start.velocity.turn - TURN.turn) < 4 * start.std_turn
    np.testing.assert_allclose(start.velocity.centre, CENTRE, atol=0.5)
    assert re.fullmatch(r"a turn by -3\.\d+ \+- 0\.00\d degrees a frame about \(\d\d\.\d, 2\d\.\d\) px", start.text)


def test_shift_is_found_within_its_expected_error_where_brightness_flickers(captured: Callable) -> None:
    start = found(captured(around(SHIFT, 64), 0.05, flicker=0.5))
    std = np.sqrt(np.diagonal(start.covariance))
    assert (std < [0.002, 0.02, 0.02]).all()
    assert (np.abs([start.velocity.turn, *(start.velocity.shift - SHIFT.shift)]) < 4 * std).all()
    assert start.text.startswith("a shift by (0.")


@pytest.mark.parametrize(
    ("motions", "contrast", "message"),
    [
        (around(TURN, 24), 0.0, "no constant velocity stands out from photon noise"),
        (around(STILL, 24), 0.8, "no constant velocity stands out from photon noise"),
        (np.concatenate([around(turning(3.6), 24), around(turning(-7.2), 24)]), 0.8, "the image does not move at a constant"),
    ],
    ids=["noise", "still scene", "changing velocity"],
)
def test_captures_without_a_constant_velocity_are_refused(
    captured: Callable, motions: np.ndarray, contrast: float, message: str
) -> None:
    with pytest.raises(LocationError, match=message):
        found(captured(motions, 0.1, contrast, flicker=0.3))
    with pytest.raises(InputError, match="7 frames are too few"):
        found(captured(motions[:7], 0.1))


FRAME = (96, 128)


def motion_of(homographies: np.ndarray, camera: Camera | None = None) -> FrameMotion:
    n_frames = len(homographies)
    located, std_px = np.ones(n_frames, bool), np.zeros(n_frames)
    return FrameMotion(
        trajectory=FrameTrajectory(homographies),
        span=FrameSpan(0, n_frames),
        homographies=homographies,
        located=located,
        std_px=std_px,
        reference=0,
        frame_shape=FRAME,
        camera=camera,
    )


def pan(tremor_px: float = 0.0, n_frames: int = 1200) -> np.ndarray:
    frames = np.arange(n_frames)
    return np.array([translation(0.2 * t + tremor_px * np.sin(t / 7), 0.1 * t) for t in frames])


def distance_px(motion: FrameMotion, instant: float, expected: np.ndarray) -> float:
    change = np.linalg.inv(expected) @ smooth_view(motion, instant, 150)
    return float(corner_displacements(change / change[2, 2], np.eye(3), FRAME).max())


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
    camera = Camera.of(100, FRAME)
    homographies = camera.homographies(rotation_matrices(np.stack([0 * angles, angles, 0 * angles], axis=-1)))
    motion = motion_of(homographies, camera)
    for instant in (0, 300, 600, 1199):  # ahead, to the side, backwards
        assert distance_px(motion, instant, homographies[instant]) < 1e-6
