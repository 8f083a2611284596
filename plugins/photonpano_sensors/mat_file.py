"""Read frames from one MATLAB file: of version 5 to 7, or of version 7.3, which is HDF5."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.reading import read_start, reading
from photonpano_sensors.mat5 import mat5_array

_VARIABLE = "OUTPUT"
_BLOCK_FRAMES = 64
_DAMAGED = "cannot be read as a MATLAB file: it is damaged or something else; copy it again"


class _Variable(NamedTuple):
    """The variable of an open file: its shape in MATLAB, and a function that reads the next frames, (n, width, height)."""

    shape: tuple[int, ...]
    read: Callable[[int, int], NDArray[Any]]


class MatFrames:
    """The frames of a file, which are not read yet.

    Attributes:
        shape: (frames, height, width).

    Raises:
        InputError: the file is damaged, or has no frames in a variable OUTPUT (height, width, frames).
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._variable = _hdf_variable if is_hdf(path) else _mat5_variable
        with reading(path, _DAMAGED), self._variable(path) as variable:
            self.shape = _frame_order(path, variable.shape)

    def packed(self) -> NDArray[np.uint8]:
        """Return all frames, (n, H, ceil(W / 8)), as `numpy.packbits` packs along the width.

        Raises:
            InputError: the file is damaged, or holds values other than 0 and 1.
        """
        n_frames, height, width = self.shape
        packed = np.empty((n_frames, height, -(-width // 8)), np.uint8)
        with reading(self._path, _DAMAGED), self._variable(self._path) as variable:
            for start in range(0, n_frames, _BLOCK_FRAMES):
                stop = min(start + _BLOCK_FRAMES, n_frames)
                frames = variable.read(start, stop).swapaxes(1, 2)
                lit = np.ascontiguousarray(frames == 1)
                if not np.all(lit | (frames == 0)):
                    raise InputError(f"{self._path} holds values other than 0 and 1: its frames are not binary")
                packed[start:stop] = np.packbits(lit, axis=-1)
        return packed


def is_hdf(path: Path) -> bool:
    """Return whether a file is one of MATLAB 7.3, by its first bytes."""
    start = read_start(path, 10)
    return start == b"MATLAB 7.3" or start.startswith(b"\x89HDF")


@contextmanager
def _mat5_variable(path: Path) -> Iterator[_Variable]:
    with mat5_array(path, _VARIABLE) as array:
        if array is None:
            raise _missing(path)
        yield _Variable(array.shape, lambda start, stop: array.read((stop - start, array.shape[1], array.shape[0])))


@contextmanager
def _hdf_variable(path: Path) -> Iterator[_Variable]:
    if importlib.util.find_spec("h5py") is None:
        install = 'pip install "photonpano[hdf5]" (in a checkout: pip install ".[hdf5]")'
        raise InputError(f"{path} is a file of MATLAB 7.3: reading it needs h5py, which is not installed: {install}")
    import h5py

    with h5py.File(path) as file:
        if _VARIABLE not in file:
            raise _missing(path)
        values = file[_VARIABLE]
        # HDF5 has the dimensions of MATLAB in reverse order.
        yield _Variable(values.shape[::-1], lambda start, stop: values[start:stop] if values.ndim == 3 else values[()][None])


def _missing(path: Path) -> InputError:
    return InputError(f"{path} has no variable {_VARIABLE}; its frames must be (height, width, frames) of that name")


def _frame_order(path: Path, shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return (frames, height, width) of (height, width, frames), whose last dimension MATLAB drops if it is 1."""
    if len(shape) not in (2, 3) or min(shape) < 1:
        raise InputError(f"{path} has {_VARIABLE} of shape {shape}; frames are (height, width, frames)")
    height, width, n_frames = (*shape, 1)[:3]
    return int(n_frames), int(height), int(width)
