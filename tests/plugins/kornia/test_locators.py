"""What the kit does not ask of the locators that need no weights: starts further off, the dark, what torch shares, memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from photonpano import Located, Locator, NotLocated, StageContext, StreamInfo, VirtualExposure
from photonpano.geometry import corner_displacements, from_parameters, translation
from photonpano.photometry import BinaryResponse
from photonpano_kornia.hooks import photonpano_locators

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
"""Locators, what they are told, and their tolerance in px at 0.5 photons per pixel per frame."""
SHIFT = translation(20.25, 7.5)
HOMOGRAPHY = from_parameters([0.01, 0.004, -0.006, 0.02, 9.0, 4.0, 2e-5, -3e-5])


@pytest.fixture(params=["registrator", "smnn"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def built(backend: str) -> Locator:
    name, config, _ = BACKENDS[backend]
    return CONTRIBUTIONS[name].build(CONTRIBUTIONS[name].config(**config), CONTEXT)


def register(
    backend: str, moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None = None
) -> Located | NotLocated:
    locator = built(backend)
    return locator.register(locator.describe(moving), locator.describe(fixed), initial)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_motion_known_so_far_is_corrected(backend: str, shot: Callable) -> None:
    motion = register(backend, shot(HOMOGRAPHY, 1), shot(STILL, 2), HOMOGRAPHY @ translation(3, -2))
    assert error_px(motion, HOMOGRAPHY) < BACKENDS[backend][2]


def test_what_is_known_so_far_tells_what_looks_alike(backend: str, photograph: Callable) -> None:
    """A wallpaper of 40 px repeats itself across the frame."""
    tile = 0.1 + np.random.default_rng(0).random((10, 10)).repeat(4, axis=0).repeat(4, axis=1)
    wallpaper = np.tile(tile, (6, 8))
    fixed, moving = photograph(wallpaper[20:140, 20:196], 0), photograph(wallpaper[23:143, 27:203], 1)
    true = translation(47, 3)
    assert error_px(register(backend, moving, fixed, translation(45, 2)), true) < BACKENDS[backend][2]


def test_in_the_dark_too(backend: str, shot: Callable) -> None:
    """At 0.02 photons per pixel per frame."""
    assert error_px(register(backend, shot(SHIFT, 1, 0.04), shot(STILL, 2, 0.04)), SHIFT) < 0.8


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


def test_what_was_not_seen_does_not_pull(backend: str, shot: Callable) -> None:
    """A third of one exposure is missing."""
    moving, unseen = shot(SHIFT, 1), np.arange(SHAPE[1]) < 50 + np.zeros((SHAPE[0], 1))
    moving = replace(
        moving, flux=np.where(unseen, np.float32(np.nan), moving.flux), weight=np.where(unseen, np.float32(0), moving.weight)
    )
    assert error_px(register(backend, moving, shot(STILL, 2)), SHIFT) < 2 * BACKENDS[backend][2]


def test_what_is_kept_of_an_exposure_is_small(backend: str, shot: Callable) -> None:
    """At most what four images of float32 take."""
    described = built(backend).describe(shot(STILL))
    kept = [described] if backend == "smnn" else described
    arrays = [getattr(each, name) for each in kept for name in type(each).__dataclass_fields__]
    assert sum(each.nbytes for each in arrays if isinstance(each, np.ndarray)) < 4 * 4 * SHAPE[0] * SHAPE[1]
