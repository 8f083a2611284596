"""What the conformance kit does not test of locators without weights: wrong initial motions, darkness, threads, memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from photonpano import InputError, Located, NotLocated, StageContext, StreamInfo
from photonpano.geometry import corner_displacements, translation
from photonpano.photometry import BinaryResponse
from photonpano_kornia.hooks import photonpano_locators

pytest.importorskip("torch")
pytest.importorskip("kornia")

import torch

from photonpano_kornia.locators import device_of, one_thread

SHAPE = (120, 176)
STILL = np.eye(3)
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
CONTRIBUTIONS = {each.name: each for each in photonpano_locators()}
BACKENDS: dict[str, tuple[str, dict[str, Any]]] = {
    "registrator": ("kornia-registrator", {}),
    "smnn": ("kornia-features", {"max_keypoints": 400}),
    "adalam": ("kornia-features", {"max_keypoints": 400, "matcher": "adalam"}),
}


@pytest.fixture(params=["registrator", "smnn"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def built(backend: str, **keys: Any) -> Any:
    name, config = BACKENDS[backend]
    return CONTRIBUTIONS[name].build(CONTRIBUTIONS[name].config(**config | keys), CONTEXT)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


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
    locator = built(backend)
    described = locator.describe(shot(STILL))
    found = located(locator.register(described, described, None))
    assert corner_displacements(found.homography, STILL, SHAPE).mean() < 1e-3


@pytest.mark.parametrize("sigma_px", [2.5, 7.0])
def test_keypoints_lie_at_centres_of_blobs(photograph: Callable, sigma_px: float) -> None:
    """To less than half a pixel, also in octaves of kornia's pyramid that are finer and coarser than the image."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    middle = np.array([83.25, 61.75])
    blob = np.exp(-((x - middle[0]) ** 2 + (y - middle[1]) ** 2) / (2 * sigma_px**2))
    found = built("smnn", max_keypoints=16).describe(photograph(0.2 + 2 * blob, 0))
    strongest = found.points[np.argmin(np.linalg.norm(found.points - middle, axis=1))]
    np.testing.assert_allclose(strongest, middle, atol=0.15)


def test_one_thread_limits_torch_and_restores_its_number() -> None:
    """Also in a thread that has not used torch before."""

    def counts(_: object = None) -> tuple[int, int]:
        with one_thread():
            torch.ones(100_000).sum()
            inside = torch.get_num_threads()
        return inside, torch.get_num_threads()

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with ThreadPoolExecutor(2) as pool:
            assert [*pool.map(counts, range(4)), counts()] == [(1, 3)] * 5
    finally:
        torch.set_num_threads(before)


def test_device_of_missing_gpu_raises_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    assert device_of("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError) as caught:
        device_of("cuda")
    assert str(caught.value) == (
        f"device: cuda is not available: torch {torch.__version__} finds no GPU; use device: cpu, or install a "
        "torch for the GPU and its driver"
    )
