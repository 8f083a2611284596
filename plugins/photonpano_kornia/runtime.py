"""Run torch on a device, without threads of its own, and without side effects on the global random generator."""

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

_GENERATOR = Lock()  # held while the global random generator is seeded, which all threads share


def device_of(name: str) -> torch.device:
    """Return the device of a config; raises an `InputError` if torch does not find it."""
    with warnings.catch_warnings():
        # A CUDA build of torch warns if there is no driver; the error below says so.
        warnings.simplefilter("ignore")
        if name == "cuda" and not torch.cuda.is_available():
            raise InputError(
                f"device: cuda is not available: torch {torch.__version__} finds no GPU; use device: cpu, or install a "
                "torch for the GPU and its driver"
            )
    return torch.device(name)


def images_on(device: torch.device, *images: NDArray[Any]) -> torch.Tensor:
    """Copy (H, W) images into a float32 tensor of shape (1, C, H, W)."""
    return torch.stack([torch.tensor(image, dtype=torch.float32, device=device) for image in images])[None]


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch from starting threads of its own, on whose number the rounding of sums depends.

    `torch.set_num_threads` acts on the whole process, the limit of OpenMP on the calling thread only.
    """
    # On its first use in a thread, torch sets the number; this call makes that happen before the limit is set.
    torch.get_num_threads()
    with _openmp().limit(limits=1):
        yield


@cache
def _openmp() -> ThreadpoolController:
    """Return the loaded OpenMP libraries, torch's among them."""
    return ThreadpoolController().select(user_api="openmp")


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed the global generators for code that samples from them, and restore them."""
    with _GENERATOR, torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
