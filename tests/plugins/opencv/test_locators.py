"""What all locators of the plugin promise."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from photonpano import Located, NotLocated, StageContext, StreamInfo
from photonpano.geometry import corner_displacements, from_parameters, inverse, translation
from photonpano.photometry import BinaryResponse
from photonpano_opencv.hooks import photonpano_locators

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano import Locator, VirtualExposure

SHAPE = (160, 240)
STILL = np.eye(3)
CONTRIBUTIONS = {each.name: each for each in photonpano_locators()}
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
TOLERANCE_PX = {"opencv-sift": 0.4, "opencv-orb": 1.2, "direct": 0.15, "opencv-ecc": 0.15, "phase-correlation": 0.15}
SHIFTS = {"sub-pixel": translation(0.3, -0.2), "shift": translation(20.25, 7.5), "backwards": translation(-31, 0)}
MOTIONS = SHIFTS | {
    "rotation": from_parameters([np.cos(0.05) - 1, np.sin(0.05), -np.sin(0.05), np.cos(0.05) - 1, 6.0, -3.0, 0, 0]),
    "homography": from_parameters([0.01, 0.004, -0.006, 0.02, 9.0, 4.0, 2e-5, -3e-5]),
}
CASES = [
    pytest.param(name, true, id=f"{name}-{kind}")
    for name in CONTRIBUTIONS
    for kind, true in (SHIFTS if name == "phase-correlation" else MOTIONS).items()
]


def built(name: str) -> Locator:
    contribution = CONTRIBUTIONS[name]
    return contribution.build(contribution.config(), CONTEXT)


@pytest.fixture(params=CONTRIBUTIONS)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


def register(
    name: str, moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None = None
) -> Located | NotLocated:
    locator = built(name)
    return locator.register(locator.describe(moving), locator.describe(fixed), initial)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def lost(motion: Located | NotLocated) -> NotLocated:
    assert isinstance(motion, NotLocated), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


@pytest.mark.parametrize(("name", "true"), CASES)
def test_known_motions_are_found_and_not_their_inverse(name: str, true: np.ndarray, seen_from: Callable) -> None:
    motion = located(register(name, seen_from(true, 1), seen_from(STILL, 2)))
    assert error_px(motion, true) < TOLERANCE_PX[name]
    if not np.array_equal(true, SHIFTS["sub-pixel"]):
        assert error_px(motion, inverse(true)) > 10
    assert motion.homography[2, 2] == 1
    assert motion.residual_px > 0
    np.linalg.cholesky(motion.information)


def test_a_motion_known_so_far_is_corrected(name: str, seen_from: Callable) -> None:
    true = SHIFTS["shift"] if name == "phase-correlation" else MOTIONS["homography"]
    motion = register(name, seen_from(true, 1), seen_from(STILL, 2), true @ translation(3, -2))
    assert error_px(motion, true) < TOLERANCE_PX[name]


def test_in_the_dark_too(name: str, seen_from: Callable) -> None:
    """At 0.02 photons per pixel and frame."""
    true = SHIFTS["shift"]
    motion = register(name, seen_from(true, 1, 0.04), seen_from(STILL, 2, 0.04))
    assert error_px(motion, true) < 3 * TOLERANCE_PX[name]


def test_the_same_input_gives_the_same_bytes_from_any_thread(name: str, seen_from: Callable) -> None:
    locator = built(name)
    exposures = [seen_from(translation(9 * index, 0), index) for index in range(3)]

    def all_pairs(threads: int) -> list[bytes]:
        with ThreadPoolExecutor(threads) as pool:
            features = list(pool.map(locator.describe, exposures))
            motions = list(pool.map(locator.register, features[1:] * 2, features[:-1] * 2, [None] * 4))
        return [located(motion).homography.tobytes() + motion.information.tobytes() for motion in motions]

    alone = all_pairs(1)
    assert alone[:2] == alone[2:]
    assert all_pairs(4) == alone


def test_exposures_are_left_as_they_are(name: str, seen_from: Callable) -> None:
    moving, fixed = seen_from(SHIFTS["shift"], 1), seen_from(STILL, 2)
    initial = SHIFTS["shift"].copy()
    for exposure in (moving, fixed):
        exposure.flux.flags.writeable = exposure.weight.flags.writeable = False
    initial.flags.writeable = False
    located(register(name, moving, fixed, initial))


def masked(exposure: VirtualExposure, unseen: np.ndarray) -> VirtualExposure:
    return replace(
        exposure,
        flux=np.where(unseen, np.float32(np.nan), exposure.flux),
        weight=np.where(unseen, np.float32(0), exposure.weight),
    )


def test_what_was_not_seen_does_not_pull(name: str, seen_from: Callable) -> None:
    """A third of one exposure is missing, and what stands there in the other is bright."""
    true = SHIFTS["shift"]
    left = np.arange(SHAPE[1]) < 80 + np.zeros((SHAPE[0], 1))
    motion = register(name, masked(seen_from(true, 1), left), seen_from(STILL, 2))
    assert error_px(motion, true) < 2 * TOLERANCE_PX[name]


def test_masked_hot_pixels_do_not_hold_it_back(name: str, seen_from: Callable) -> None:
    """One in fifty, at the same places in both, as on a sensor."""
    hot = np.random.default_rng(7).random(SHAPE) < 0.02
    true = SHIFTS["shift"]
    motion = register(name, *(masked(each, hot) for each in (seen_from(true, 1), seen_from(STILL, 2))))
    assert error_px(motion, true) < 2 * TOLERANCE_PX[name]


@pytest.mark.parametrize("initial", [None, STILL, translation(230, 0)], ids=["unknown", "still", "apart"])
def test_without_texture_nothing_is_located(
    name: str, initial: np.ndarray | None, photograph: Callable, seen_from: Callable
) -> None:
    """A wall, the dark, what was not seen, all of it lit: each with its like, and with the street."""
    walls = [photograph(np.full(SHAPE, flux), seed) for seed, flux in enumerate((0.5, 0.0, 0.0, 50.0))]
    walls[2] = masked(walls[2], np.ones(SHAPE, bool))
    street = seen_from(STILL)
    for seed, wall in enumerate(walls):
        other = photograph(np.full(SHAPE, 0.5), 9) if seed == 0 else wall
        for pair in ((wall, other), (wall, street), (street, wall)):
            assert lost(register(name, *pair, initial)).reason


@pytest.mark.parametrize("initial", [None, STILL], ids=["unknown", "still"])
def test_another_place_is_not_located(name: str, initial: np.ndarray | None, seen_from: Callable) -> None:
    lost(register(name, seen_from(translation(0, 330), 1), seen_from(STILL, 2), initial))
