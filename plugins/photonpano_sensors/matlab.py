"""Read frames from one MATLAB file: of version 4 to 7 with scipy, or of version 7.3, which is HDF5, with h5py."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.reading import read_start, reading

_VARIABLE = "OUTPUT"
_BLOCK_FRAMES = 64  # frames that are packed at once
_DAMAGED = "cannot be read as a MATLAB file: it is damaged or something else; copy it again"


def shape_of_frames(path: Path) -> tuple[int, int, int]:
    """Return (frames, height, width) from the headers of a file; raises an `InputError` if it has no frames in OUTPUT."""
    with reading(path, _DAMAGED):
        if _is_hdf(path):
            with _hdf_values(path) as values:
                shape = values.shape[::-1]  # HDF5 has the dimensions of MATLAB in reverse order
        else:
            from scipy.io import whosmat

            shapes = {name: shape for name, shape, _ in whosmat(str(path))}
            if _VARIABLE not in shapes:
                raise _missing(path)
            shape = shapes[_VARIABLE]
    if len(shape) not in (2, 3) or min(shape) < 1:
        raise InputError(f"{path} has {_VARIABLE} of shape {shape}; frames are (height, width, frames)")
    height, width, n_frames = (*shape, 1)[:3]  # MATLAB drops the last dimension if it is 1
    return int(n_frames), int(height), int(width)


def packed_frames(path: Path) -> NDArray[np.uint8]:
    """Return all frames, (n, H, ceil(W / 8)), packed along the width; raises an `InputError` if they are not binary."""
    with reading(path, _DAMAGED):
        if _is_hdf(path):
            with _hdf_values(path) as values:
                stored = values[()].T
        else:
            from scipy.io import loadmat

            stored = loadmat(str(path), variable_names=[_VARIABLE])[_VARIABLE]
        frames = np.moveaxis(np.atleast_3d(stored), -1, 0)
        if frames.dtype.kind not in "biuf":
            raise InputError(f"{path} has {_VARIABLE} that is no array of real numbers; frames are (height, width, frames)")
        packed = np.empty((*frames.shape[:2], -(-frames.shape[2] // 8)), np.uint8)
        for start in range(0, len(frames), _BLOCK_FRAMES):
            block = slice(start, start + _BLOCK_FRAMES)
            lit = frames[block] == 1
            if not np.all(lit | (frames[block] == 0)):
                raise InputError(f"{path} holds values other than 0 and 1: its frames are not binary")
            packed[block] = np.packbits(lit, axis=-1)
    return packed


def _is_hdf(path: Path) -> bool:
    """Return whether a file is one of MATLAB 7.3, by its first bytes."""
    start = read_start(path, 10)
    return start == b"MATLAB 7.3" or start.startswith(b"\x89HDF")


@contextmanager
def _hdf_values(path: Path) -> Iterator[Any]:
    """Open the array of the frames, (frames, width, height), whose values are not read yet."""
    if importlib.util.find_spec("h5py") is None:
        install = 'pip install "photonpano[hdf5]" (in a checkout: pip install ".[hdf5]")'
        raise InputError(f"{path} is a file of MATLAB 7.3: reading it needs h5py, which is not installed: {install}")
    import h5py

    with h5py.File(path) as file:
        if _VARIABLE not in file:
            raise _missing(path)
        yield file[_VARIABLE]


def _missing(path: Path) -> InputError:
    return InputError(f"{path} has no variable {_VARIABLE}; its frames must be (height, width, frames) of that name")
