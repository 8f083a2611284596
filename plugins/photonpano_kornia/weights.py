"""Load LoFTR with weights from a file."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from kornia.feature import LoFTR
from kornia.feature.loftr.loftr import default_cfg

from photonpano import InputError
from photonpano_kornia.runtime import seeded


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
