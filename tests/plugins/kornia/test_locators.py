"""What the locators promise that need no weights."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from photonpano import Located, NotLocated, StageContext, StreamInfo
from photonpano.geometry import apply, corner_displacements, corners, from_parameters, inverse, jacobian, translation
from photonpano.photometry import BinaryResponse
from photonpano_kornia.hooks import photonpano_locators

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano import Locator, VirtualExposure

pytest.importorskip("torch")
pytest.importorskip("kornia")

import torch

SHAPE = (120, 176)
STILL = np.eye(3)
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
CONTRIBUTIONS = {each.name: each for each in photonpano_locators()}
BACKENDS = {
    "registrator": ("kornia-registrator", {}, 0.12),
    "smnn": ("kornia-features", {"max_keypoints": 400}, 0.3),
    "adalam": ("kornia-features", {"max_keypoints": 400, "matcher": "adalam"}, 0.3),
}
"""Locators, what they are told, and their tolerance in px at 0.5 photons per pixel and frame."""
MOTIONS = {
    "sub-pixel": translation(0.3, -0.2),
    "shift": translation(20.25, 7.5),
    "backwards": translation(-31, 4),
    "rotation": from_parameters([np.cos(0.05) - 1, np.sin(0.05), -np.sin(0.05), np.cos(0.05) - 1, 6.0, -3.0, 0, 0]),
    "homography": from_parameters([0.01, 0.004, -0.006, 0.02, 9.0, 4.0, 2e-5, -3e-5]),
}


@pytest.fixture(params=["registrator", "smnn"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def built(backend: str) -> Locator:
    name, config, _ = BACKENDS[backend]
    return CONTRIBUTIONS[name].build(CONTRIBUTIONS[name].config(**config), CONTEXT)


def register(
    backend: str, moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None = None, **config: object
):
    locator = built(backend, **config)
    return locator.register(locator.describe(moving), locator.describe(fixed), initial)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


CASES = [(backend, kind) for backend in ("registrator", "smnn") for kind in MOTIONS]


# AdaLAM differs only in how it matches.
@pytest.mark.parametrize(("backend", "kind"), [*CASES, ("adalam", "homography")])
def test_known_motions_are_found_and_not_their_inverse(backend: str, kind: str, shot: Callable) -> None:
    true = MOTIONS[kind]
    motion = located(register(backend, shot(true, 1), shot(STILL, 2)))
    assert error_px(motion, true) < BACKENDS[backend][2]
    if kind != "sub-pixel":
        assert error_px(motion, inverse(true)) > 10
    assert motion.homography[2, 2] == 1
    assert motion.residual_px > 0
    np.linalg.cholesky(motion.information)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_motion_known_so_far_is_corrected(backend: str, shot: Callable) -> None:
    true = MOTIONS["homography"]
    motion = register(backend, shot(true, 1), shot(STILL, 2), true @ translation(3, -2))
    assert error_px(motion, true) < BACKENDS[backend][2]


def test_what_is_known_so_far_tells_what_looks_alike(backend: str, photograph: Callable) -> None:
    """A wallpaper of 40 px repeats itself across the frame."""
    tile = 0.1 + np.random.default_rng(0).random((10, 10)).repeat(4, axis=0).repeat(4, axis=1)
    wallpaper = np.tile(tile, (6, 8))
    fixed, moving = photograph(wallpaper[20:140, 20:196], 0), photograph(wallpaper[23:143, 27:203], 1)
    true = translation(47, 3)
    assert error_px(register(backend, moving, fixed, translation(45, 2)), true) < BACKENDS[backend][2]


def test_in_the_dark_too(backend: str, shot: Callable) -> None:
    """At 0.02 photons per pixel and frame."""
    true = MOTIONS["shift"]
    assert error_px(register(backend, shot(true, 1, 0.04), shot(STILL, 2, 0.04)), true) < 0.8


def test_the_information_is_that_of_the_scatter(backend: str, shot: Callable) -> None:
    # Whole pixels: between them, the fixture samples its street bluntly, and the images differ by more than noise.
    true, frame, locator = translation(10, -3), corners(SHAPE), built(backend)
    errors, predicted = [], []
    for seed in range(5):
        pair = (locator.describe(shot(each, 2 * seed + i, 0.2)) for i, each in enumerate((true, STILL)))
        motion = located(locator.register(*pair, true))
        to_corners = jacobian(motion.homography, frame).reshape(8, 8)
        predicted.append(np.trace(to_corners @ np.linalg.inv(motion.information) @ to_corners.T))
        errors.append(np.sum((apply(motion.homography, frame) - apply(true, frame)) ** 2))
    assert 1 / 3 < np.sqrt(np.mean(errors) / np.mean(predicted)) < 3


@pytest.fixture
def threads() -> None:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_same_input_gives_the_same_bytes_from_any_thread(backend: str, shot: Callable) -> None:
    """However many threads torch would use, and whatever it would draw next; both are left as they were."""
    locator = built(backend)
    exposures = [shot(translation(9 * index, 0), index) for index in range(3)]

    def all_pairs(threads: int) -> list[bytes]:
        torch.set_num_threads(threads)
        torch.manual_seed(threads)
        state = torch.get_rng_state()
        with ThreadPoolExecutor(threads) as pool:
            features = list(pool.map(locator.describe, exposures))
            motions = list(pool.map(locator.register, features[1:], features[:-1], [None] * 2))
        assert torch.get_num_threads() == threads
        assert torch.equal(torch.get_rng_state(), state)
        return [located(motion).homography.tobytes() + motion.information.tobytes() for motion in motions]

    assert all_pairs(1) == all_pairs(3)


def test_an_exposure_lies_where_it_lies(backend: str, shot: Callable) -> None:
    exposure = shot(STILL)
    assert error_px(register(backend, exposure, exposure), STILL) < 1e-3


def test_exposures_are_left_as_they_are(backend: str, shot: Callable) -> None:
    moving, fixed, initial = shot(MOTIONS["shift"], 1), shot(STILL, 2), MOTIONS["shift"].copy()
    for array in (moving.flux, moving.weight, fixed.flux, fixed.weight, initial):
        array.flags.writeable = False
    located(register(backend, moving, fixed, initial))


def masked(exposure: VirtualExposure, unseen: np.ndarray) -> VirtualExposure:
    return replace(
        exposure,
        flux=np.where(unseen, np.float32(np.nan), exposure.flux),
        weight=np.where(unseen, np.float32(0), exposure.weight),
    )


def test_what_was_not_seen_does_not_pull(backend: str, shot: Callable) -> None:
    """A third of one exposure is missing; at the same places, one pixel in fifty of both, as on a sensor."""
    true = MOTIONS["shift"]
    left = np.arange(SHAPE[1]) < 50 + np.zeros((SHAPE[0], 1))
    hot = np.random.default_rng(7).random(SHAPE) < 0.02
    for unseen in ((left, np.zeros(SHAPE, bool)), (hot, hot)):
        pair = (masked(shot(each, seed), mask) for seed, (each, mask) in enumerate(zip((true, STILL), unseen, strict=True)))
        assert error_px(register(backend, *pair), true) < 2 * BACKENDS[backend][2]


@pytest.mark.parametrize("initial", [None, STILL, translation(170, 0)], ids=["unknown", "still", "apart"])
def test_without_texture_nothing_is_located(
    backend: str, initial: np.ndarray | None, photograph: Callable, shot: Callable
) -> None:
    """A wall, the dark, what was not seen, all of it lit: each with its like, and with the street."""
    locator = built(backend)
    walls = [photograph(np.full(SHAPE, flux), seed) for seed, flux in enumerate((0.5, 0.0, 0.0, 50.0))]
    walls[2] = masked(walls[2], np.ones(SHAPE, bool))
    street, other, *described = map(locator.describe, (shot(STILL), photograph(np.full(SHAPE, 0.5), 9), *walls))
    for index, wall in enumerate(described):
        for pair in ((wall, wall if index else other), (wall, street), (street, wall)):
            motion = locator.register(*pair, initial)
            assert isinstance(motion, NotLocated), (index, motion)
            assert motion.reason


@pytest.mark.parametrize("initial", [None, STILL], ids=["unknown", "still"])
def test_another_place_is_not_located(backend: str, initial: np.ndarray | None, shot: Callable) -> None:
    motion = register(backend, shot(translation(0, 250), 1), shot(STILL, 2), initial)
    assert isinstance(motion, NotLocated), motion


@pytest.mark.parametrize("shape", [(24, 40), (9, 17), (1, 8)])
def test_images_may_be_tiny(backend: str, shape: tuple[int, int], photograph: Callable) -> None:
    tiny = photograph(np.random.default_rng(0).random(shape))
    register(backend, tiny, tiny)


def test_what_is_kept_of_an_exposure_is_small(backend: str, shot: Callable) -> None:
    """At most what four images of float32 take."""
    described = built(backend).describe(shot(STILL))
    kept = [described] if backend == "smnn" else described
    arrays = [getattr(each, name) for each in kept for name in type(each).__dataclass_fields__]
    assert sum(each.nbytes for each in arrays if isinstance(each, np.ndarray)) < 4 * 4 * SHAPE[0] * SHAPE[1]
