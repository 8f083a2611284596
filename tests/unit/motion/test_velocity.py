"""A constant velocity from all frames together: small captures of 64x96 px in memory, whose motion is known."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano.context import Context
from photonpano.errors import InputError, LocationError
from photonpano.geometry import inverse, transform_points, translation
from photonpano.motion.tracking.velocity import ConstantVelocity, FoundVelocity, Velocity, find_velocity
from photonpano.testing.scenes import detected, seen_along, textured

SHAPE = (64, 96)
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


def test_velocity_leaves_the_centre_where_it_is_and_adds_up() -> None:
    once, twice = TURN.after([3.0, 6.0])
    np.testing.assert_allclose(TURN.centre, CENTRE)
    np.testing.assert_allclose(transform_points(once, CENTRE[None])[0], CENTRE)
    np.testing.assert_allclose(once @ once, twice, atol=1e-9)
    np.testing.assert_allclose(SHIFT.after([5.0])[0][:2, 2], [3, -1])


def test_trajectory_maps_frames_to_the_reference() -> None:
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
        (around(TURN, 32), 0.0, "no constant velocity stands out from photon noise"),
        (around(STILL, 32), 0.8, "no constant velocity stands out from photon noise"),
        (np.concatenate([around(turning(3.6), 32), around(turning(-7.2), 32)]), 0.8, "the image does not move at a constant"),
    ],
    ids=["noise", "still scene", "changing velocity"],
)
def test_captures_without_a_constant_velocity_are_refused(
    captured: Callable, motions: np.ndarray, contrast: float, message: str
) -> None:
    with pytest.raises(LocationError, match=message):
        found(captured(motions, 0.1, contrast, flicker=0.3))


def test_too_few_frames_are_refused(captured: Callable) -> None:
    with pytest.raises(InputError, match="7 frames are too few"):
        found(captured(around(SHIFT, 7), 0.1))


def test_what_changes_at_its_place_is_no_motion(memory_source: type) -> None:
    rng = np.random.default_rng(0)
    blobs = cv2.GaussianBlur(rng.normal(0, 1, SHAPE), (0, 0), 2) > 0
    frames = [rng.random(SHAPE) < 0.05 + 0.4 * blobs * (1 + np.sin(index / 3)) * (np.arange(96) < 48) for index in range(32)]
    with pytest.raises(LocationError, match="stays at its place in the frame"):
        found(memory_source(frames))
