"""How torch is used in a run: on which device, without threads of its own, and without touching the global generator."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

import torch
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from photonpano import InputError

_GENERATOR = Lock()
"""Held while the global generator is borrowed: all threads share it."""


def device_of(name: str) -> torch.device:
    """Return the device of a config.

    Raises:
        InputError: torch finds no such device.
    """
    with warnings.catch_warnings():
        # A torch that was built for GPUs warns where there is no driver; what is wrong is said below.
        warnings.simplefilter("ignore")
        if name == "cuda" and not torch.cuda.is_available():
            raise InputError(
                f"device: cuda is asked for, but torch {torch.__version__} finds no GPU here; say device: cpu, or install "
                "a torch that was built for the GPU and its driver"
            )
    return torch.device(name)


def images_on(device: torch.device, *images: NDArray[Any]) -> torch.Tensor:
    """Copy (H, W) images into a float32 tensor of kornia's order: (1, C, H, W)."""
    return torch.stack([torch.tensor(image, dtype=torch.float32, device=device) for image in images])[None]


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch from starting threads under those of the run: they would fight, and sums would depend on their number.

    `torch.set_num_threads` would change the number for the whole process; that of OpenMP belongs to the calling thread.
    """
    # Where a thread first uses torch, torch sets the number itself; asking for it makes that happen now.
    torch.get_num_threads()
    with _openmp().limit(limits=1):
        yield


@cache
def _openmp() -> ThreadpoolController:
    """Return the OpenMP libraries that are loaded, torch's among them."""
    return ThreadpoolController().select(user_api="openmp")


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed the global generators for what draws from them without being asked, and put them back."""
    with _GENERATOR, torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
