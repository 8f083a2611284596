"""What the conformance kit does not test of locators without weights: wrong initial motions, darkness, threads, memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from photonpano import Located, Locator, NotLocated, StageContext, StreamInfo, VirtualExposure
from photonpano.geometry import corner_displacements, translation
from photonpano.photometry import BinaryResponse
from photonpano_kornia.hooks import photonpano_locators

pytest.importorskip("torch")
pytest.importorskip("kornia")

import torch

SHAPE = (120, 176)
STILL = np.eye(3)
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
CONTRIBUTIONS = {each.name: each for each in photonpano_locators()}
# Locators, their configs, and their tolerance in px at 0.5 photons per pixel per frame.
BACKENDS = {
    "registrator": ("kornia-registrator", {}, 0.12),
    "smnn": ("kornia-features", {"max_keypoints": 400}, 0.3),
    "adalam": ("kornia-features", {"max_keypoints": 400, "matcher": "adalam"}, 0.3),
}


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


@pytest.fixture
def threads() -> None:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("backend", BACKENDS)
def test_result_is_independent_of_threads_and_generator_state(backend: str, shot: Callable) -> None:
    """Torch's number of threads and its generator are left unchanged."""
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


def test_exposure_registered_to_itself_gives_identity(backend: str, shot: Callable) -> None:
    exposure = shot(STILL)
    assert error_px(register(backend, exposure, exposure), STILL) < 1e-3


def test_description_takes_less_memory_than_four_images(backend: str, shot: Callable) -> None:
    """Images of float32."""
    described = built(backend).describe(shot(STILL))
    kept = [described] if backend == "smnn" else described
    arrays = [getattr(each, name) for each in kept for name in type(each).__dataclass_fields__]
    assert sum(each.nbytes for each in arrays if isinstance(each, np.ndarray)) < 4 * 4 * SHAPE[0] * SHAPE[1]
