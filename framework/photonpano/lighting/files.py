"""The light of a run as a file: light.npz."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from photonpano.capture import in_light
from photonpano.errors import InputError
from photonpano.protocols import Source
from photonpano.values import Light

LIGHT_FILE = "light.npz"
_ARRAYS = ("gain", "waves", "maps", "to_map", "frequency", "std")


def write_light(folder: Path, light: Light) -> None:
    """Write light.npz into a folder."""
    arrays: dict[str, Any] = {name: np.asarray(getattr(light, name)) for name in _ARRAYS}
    np.savez(folder / LIGHT_FILE, **arrays)


def in_light_of(source: Source, folder: Path) -> Source:
    """Return a capture in the light that a run folder holds; as it is, if the run found steady light.

    Raises:
        InputError: light.npz is damaged, or of a capture with another number of frames.
    """
    path = folder / LIGHT_FILE
    if not path.exists():
        return source
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays: dict[str, Any] = {name: archive[name] for name in _ARRAYS}
        light = Light(**{**arrays, "frequency": float(arrays["frequency"])})
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as the light of a run ({error}); run again") from error
    if len(light.gain) != source.info.n_frames:
        raise InputError(
            f"{path} is the light of {len(light.gain)} frames, but the capture has {source.info.n_frames}; run again"
        )
    return in_light(source, light)
