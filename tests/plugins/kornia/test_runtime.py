from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from photonpano import InputError

pytest.importorskip("torch")
pytest.importorskip("kornia")

import torch

from photonpano_kornia.runtime import device_of, images_on, one_thread, seeded


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


def test_seeded_restores_the_generator_state() -> None:
    before = torch.get_rng_state()
    drawn = []
    for seed in (1, 1, 2):
        with seeded(seed, torch.device("cpu")):
            drawn.append(torch.rand(3))
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert torch.equal(torch.get_rng_state(), before)


def test_device_of_missing_gpu_raises_input_error(monkeypatch: pytest.MonkeyPatch) -> None:
    assert device_of("cpu") == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError) as caught:
        device_of("cuda")
    assert str(caught.value) == (
        f"device: cuda is not available: torch {torch.__version__} finds no GPU; use device: cpu, or install a "
        "torch for the GPU and its driver"
    )


def test_images_on_copies_images() -> None:
    image = np.zeros((2, 3), np.float32)
    image.flags.writeable = False
    tensor = images_on(torch.device("cpu"), image, image > 0)
    assert tensor.shape == (1, 2, 2, 3)
    tensor += 1
    assert not image.any()
