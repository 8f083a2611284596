"""Run torch without threads of its own and side effects on the global random generator, and load weights of LoFTR."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any

import torch
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg
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


def image_on(device: torch.device, image: NDArray[Any]) -> torch.Tensor:
    """Copy an (H, W) image into a float32 tensor of shape (1, 1, H, W)."""
    return torch.tensor(image, dtype=torch.float32, device=device)[None, None]


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


def loftr_from(path: Path, device: torch.device, *, corrected_positions: bool, min_confidence: float) -> LoFTR:
    """Return LoFTR with the weights of a file of `torch.save`, ready for inference; only tensors are read, no code is run.

    Raises an `InputError` if the file cannot be read, or holds something else than tensors by name, or these under
    `state_dict`.
    """
    weights = _read(path)
    config = copy.deepcopy(default_cfg)
    config["coarse"]["temp_bug_fix"] = corrected_positions
    config["match_coarse"]["thr"] = min_confidence
    # Construction initialises the weights at random.
    with seeded(0, torch.device("cpu")):
        network = LoFTR(pretrained=None, config=config)
    if reason := _mismatch(network.state_dict(), weights):
        raise InputError(f"{path} does not hold the weights of LoFTR: {reason}")
    network.load_state_dict(weights)
    return network.requires_grad_(False).eval().to(device)


def _read(path: Path) -> dict[str, torch.Tensor]:
    try:
        loaded: Any = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InputError(f"there is no file {path} with weights of LoFTR; check the path") from None
    except Exception as error:  # its type depends on where the file is damaged
        raise InputError(f"torch cannot read weights from {path}: {type(error).__name__}") from error
    if isinstance(loaded, Mapping):
        loaded = loaded.get("state_dict", loaded)
    if not isinstance(loaded, Mapping) or not all(isinstance(each, torch.Tensor) for each in loaded.values()):
        raise InputError(f"{path} does not hold the weights of LoFTR: expected tensors by name, or under state_dict")
    return {str(name).removeprefix("matcher."): tensor for name, tensor in loaded.items()}


def _mismatch(expected: Mapping[str, torch.Tensor], given: Mapping[str, torch.Tensor]) -> str | None:
    """Return which tensor is missing, unknown or of another shape; None if all match."""
    if missing := [name for name in expected if name not in given]:
        return f"{len(missing)} of {len(expected)} tensors are missing, such as {missing[0]}"
    if unknown := [name for name in given if name not in expected]:
        return f"{len(unknown)} of its {len(given)} tensors do not belong to LoFTR, such as {unknown[0]}"
    for name, tensor in expected.items():
        if given[name].shape != tensor.shape:
            return f"{name} has the shape {tuple(given[name].shape)}, expected {tuple(tensor.shape)}"
    return None
