"""What the conformance kit does not test: large shifts, wrong initial motions, darkness, masked areas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Located, LocatesTurns, Locator, NotLocated, StageContext, StreamInfo, VirtualExposure
from photonpano.geometry import Camera, corner_displacements, from_parameters, rotation_matrices, scaled_ahead, translation
from photonpano.photometry import BinaryResponse
from photonpano_opencv.hooks import photonpano_locators

SHAPE = (160, 240)
STILL = np.eye(3)
CONTRIBUTIONS = {each.name: each for each in photonpano_locators()}
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
TOLERANCE_PX = {"opencv-sift": 0.4, "opencv-orb": 1.2, "direct": 0.15, "opencv-ecc": 0.15, "phase-correlation": 0.15}
SHIFT = translation(20.25, 7.5)
HOMOGRAPHY = from_parameters([0.01, 0.004, -0.006, 0.02, 9.0, 4.0, 2e-5, -3e-5])


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


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


def test_locator_finds_shift_of_48_px(name: str, seen_from: Callable) -> None:
    true = translation(-48, 0)
    assert error_px(register(name, seen_from(true, 1), seen_from(STILL, 2)), true) < TOLERANCE_PX[name]


def test_locator_corrects_initial_motion_off_by_3_px(name: str, seen_from: Callable) -> None:
    true = SHIFT if name == "phase-correlation" else HOMOGRAPHY
    motion = register(name, seen_from(true, 1), seen_from(STILL, 2), true @ translation(3, -2))
    assert error_px(motion, true) < TOLERANCE_PX[name]


def test_locator_works_in_the_dark(name: str, seen_from: Callable) -> None:
    """At 0.02 photons per pixel per frame."""
    motion = register(name, seen_from(SHIFT, 1, 0.04), seen_from(STILL, 2, 0.04))
    assert error_px(motion, SHIFT) < 3 * TOLERANCE_PX[name]


def masked(exposure: VirtualExposure, unseen: np.ndarray) -> VirtualExposure:
    return replace(
        exposure,
        flux=np.where(unseen, np.float32(np.nan), exposure.flux),
        weight=np.where(unseen, np.float32(0), exposure.weight),
    )


def test_masked_third_does_not_bias_motion(name: str, seen_from: Callable) -> None:
    """A third of one exposure is masked; in the other it is bright."""
    true = SHIFT
    left = np.arange(SHAPE[1]) < 80 + np.zeros((SHAPE[0], 1))
    motion = register(name, masked(seen_from(true, 1), left), seen_from(STILL, 2))
    assert error_px(motion, true) < 2 * TOLERANCE_PX[name]


@pytest.mark.parametrize(("name", "seeds"), [("opencv-sift", (21, 28)), ("opencv-orb", (0, 7))], indirect=["name"])
def test_turning_locates_pairs_in_the_dark_that_homographies_lose(
    name: str, seeds: tuple[int, ...], seen_from: Callable
) -> None:
    """At 0.001 photons per pixel per frame, 250 frames; the motion known so far is off by 3 px."""
    camera = Camera.of(300.0, SHAPE)
    true = scaled_ahead(camera.homographies(rotation_matrices([0.02, -0.05, 0.02])))
    locator = built(name)
    assert isinstance(locator, LocatesTurns)
    for seed in seeds:
        pair = [locator.describe(seen_from(each, 2 * seed + index, 0.002)) for index, each in enumerate((true, STILL))]
        assert isinstance(locator.register(*pair, true @ translation(2, -2)), NotLocated)
        motion = located(locator.turning(camera.matrix).register(*pair, true @ translation(2, -2)))
        assert error_px(motion, true) < 3
        assert motion.evidence["degrees_of_freedom"] == 3
