"""Frames in one MATLAB file: by scipy up to version 7, by h5py from 7.3 on, when they are HDF5."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Protocol

import numpy as np

from photonpano import InputError
from photonpano.reading import read_start
from photonpano_sensors.damage import reading

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_VARIABLE = "OUTPUT"
_BLOCK_FRAMES = 64


class MatFrames(Protocol):
    """The frames of a file.

    Attributes:
        shape: (frames, height, width).
    """

    shape: tuple[int, int, int]

    def packed(self) -> NDArray[np.uint8]:
        """Return all frames, (n, H, ceil(W / 8)), as `numpy.packbits` packs along the width.

        Raises:
            InputError: the file is damaged, or holds values other than 0 and 1.
        """
        ...


def frames_of(path: Path) -> MatFrames:
    """Find the frames of a file without reading them.

    Raises:
        InputError: the file is damaged, or has no frames in a variable OUTPUT (height, width, frames).
    """
    start = read_start(path, 10)
    if start != b"MATLAB 7.3" and not start.startswith(b"\x89HDF"):
        return _OldFrames(path)
    if importlib.util.find_spec("h5py") is None:
        raise InputError(f"{path} is a file of MATLAB 7.3, which takes h5py: pip install photonpano[hdf5]")
    return _HdfFrames(path)


class _OldFrames:
    def __init__(self, path: Path) -> None:
        from scipy.io import whosmat

        with reading(path, "a MATLAB file"):
            shapes = {name: shape for name, shape, _ in whosmat(path)}
        self.shape = _frame_order(path, shapes.get(_VARIABLE))
        self._path = path

    def packed(self) -> NDArray[np.uint8]:
        from scipy.io import loadmat

        n_frames, height, width = self.shape
        with reading(self._path, "a MATLAB file"):
            values = np.asarray(loadmat(self._path, variable_names=[_VARIABLE])[_VARIABLE])
            return _packed(self._path, np.moveaxis(values.reshape(height, width, n_frames), -1, 0))


class _HdfFrames:
    def __init__(self, path: Path) -> None:
        import h5py

        with reading(path, "a MATLAB file"), h5py.File(path) as file:
            shape = file[_VARIABLE].shape[::-1] if _VARIABLE in file else None
        self.shape = _frame_order(path, shape)
        self._path = path

    def packed(self) -> NDArray[np.uint8]:
        import h5py

        n_frames, height, width = self.shape
        packed = np.empty((n_frames, height, -(-width // 8)), np.uint8)
        with reading(self._path, "a MATLAB file"), h5py.File(self._path) as file:
            values = file[_VARIABLE]
            for start in range(0, n_frames, _BLOCK_FRAMES):
                block = slice(start, min(start + _BLOCK_FRAMES, n_frames))
                frames = np.asarray(values[block] if values.ndim == 3 else values[()][None])
                packed[block] = _packed(self._path, frames.swapaxes(1, 2))
        return packed


def _frame_order(path: Path, shape: tuple[int, ...] | None) -> tuple[int, int, int]:
    """Return (frames, height, width) of MATLAB's (height, width, frames), whose last dimension it drops if it is 1."""
    if shape is None:
        raise InputError(f"{path} has no variable {_VARIABLE}; its frames must be (height, width, frames) of that name")
    if len(shape) not in (2, 3) or min(shape) < 1:
        raise InputError(f"{path} has {_VARIABLE} of shape {tuple(shape)}; frames are (height, width, frames)")
    height, width, n_frames = (*map(int, shape), 1)[:3]
    return n_frames, height, width


def _packed(path: Path, frames: NDArray[np.generic]) -> NDArray[np.uint8]:
    lit = np.ascontiguousarray(frames == 1)
    if not np.all(lit | (frames == 0)):
        raise InputError(f"{path} holds values other than 0 and 1: its frames are not binary")
    return np.packbits(lit, axis=-1)
