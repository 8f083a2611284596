"""Arrays that a config names: homographies, rates and masks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.reading import read_array


def read_homographies(path: Path, n_frames: int) -> NDArray[np.float64]:
    """Read (n_frames, 3, 3) homographies from a .npy file, or from `homographies` in an .npz archive.

    Raises:
        InputError: the file is missing, is something else, or has another number of homographies.
    """
    homographies = read_array(path, "a file of homographies", "homographies")
    if homographies.ndim != 3 or homographies.shape[1:] != (3, 3) or homographies.dtype.kind not in "fiu":
        raise InputError(f"{path} holds {homographies.dtype} of shape {homographies.shape}; homographies are (n_frames, 3, 3)")
    if len(homographies) != n_frames:
        raise InputError(
            f"{path} holds {len(homographies)} homographies for {n_frames} frames; set n_frames to {len(homographies)}"
        )
    if not (np.all(np.isfinite(homographies)) and np.all(homographies[:, 2, 2])):
        raise InputError(f"{path} holds homographies that are not finite, or whose h33 is 0")
    return homographies.astype(np.float64)


def read_rates(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.float32]:
    """Read (H, W) rates per frame period.

    Raises:
        InputError: the file is missing, is something else, or holds rates that are negative or not finite.
    """
    rates = read_array(path, "a file of rates")
    if rates.shape != frame_shape or rates.dtype.kind not in "fiu":
        raise InputError(
            f"{path} holds {rates.dtype} of shape {rates.shape}; rates are numbers of the frame's shape {frame_shape}"
        )
    if not (np.all(np.isfinite(rates)) and np.all(rates >= 0)):
        raise InputError(f"{path} holds rates that are negative or not finite")
    return rates.astype(np.float32)


def read_mask(path: Path, frame_shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Read an (H, W) mask.

    Raises:
        InputError: the file is missing or is something else.
    """
    mask = read_array(path, "a mask")
    if mask.shape != frame_shape or mask.dtype != np.bool_:
        raise InputError(f"{path} holds {mask.dtype} of shape {mask.shape}; a mask is bool of the frame's shape {frame_shape}")
    return mask
