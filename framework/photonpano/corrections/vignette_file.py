"""The vignette of a run as a file: vignette.npz."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from photonpano.corrections.vignette import Vignette
from photonpano.errors import InputError
from photonpano.reading import read_arrays

if TYPE_CHECKING:
    from photonpano.protocols import Source

VIGNETTE_FILE = "vignette.npz"


def write_vignette(folder: Path, vignette: Vignette) -> None:
    """Write vignette.npz into a folder."""
    arrays = {"gain": vignette.gain, "mean": vignette.mean}
    if vignette.std is not None:
        arrays["std"] = vignette.std
    np.savez(folder / VIGNETTE_FILE, allow_pickle=False, **arrays)


def read_vignette(folder: Path, source: Source) -> Vignette | None:
    """Read the vignette by which a run has divided its capture; None if it found none.

    Args:
        folder: the run folder.
        source: the capture.

    Raises:
        InputError: vignette.npz is damaged, or of frames of another size.
    """
    path = folder / VIGNETTE_FILE
    if not path.exists():
        return None
    arrays = read_arrays(path, "the vignette of a run")
    shape = source.info.frame_shape
    for name in ("gain", "mean"):
        image = arrays.get(name)
        if image is None or image.dtype != np.float32 or image.shape != shape:
            held = "missing" if image is None else f"{image.dtype} of shape {image.shape}"
            raise InputError(f"{path}: {name} must be float32 of shape {shape}, as the frames, and is {held}; run again")
    return Vignette(arrays["gain"], arrays["mean"], (), arrays.get("std"))
