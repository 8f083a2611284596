"""Read frames from one MATLAB file, in pieces: of version 5 to 7, or of version 7.3, which is HDF5.

Version 5 is described in MathWorks, "MAT-File Level 5 File Format". scipy.io reads it too, but only whole arrays, and it ends
the process for some damaged files.
"""

from __future__ import annotations

import importlib.util
import io
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.reading import read_start, reading

Stream: TypeAlias = IO[bytes] | io.BufferedReader

_VARIABLE = "OUTPUT"
_BLOCK_FRAMES = 64
_DAMAGED = "cannot be read as a MATLAB file: it is damaged or something else; copy it again"
_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# classes of numeric arrays; the others are cells, structures, objects, text and sparse matrices
_NUMBERS = range(6, 16)
_COMPLEX = 0x0800
_MOST_BYTES = 1024  # upper limit of the size of a name or of dimensions
_BLOCK_BYTES = 256 * 1024


class _Variable(NamedTuple):
    """The variable of an open file: its shape in MATLAB, and a function that reads the next frames, (n, width, height)."""

    shape: tuple[int, ...]
    read: Callable[[int, int], NDArray[Any]]


class MatFrames:
    """The frames of a file, (frames, height, width), not read yet; raises an `InputError` if there are none in OUTPUT."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._variable = _hdf_variable if is_hdf(path) else _mat5_variable
        with reading(path, _DAMAGED), self._variable(path) as variable:
            self.shape = _frame_order(path, variable.shape)

    def packed(self) -> NDArray[np.uint8]:
        """Return all frames, (n, H, ceil(W / 8)), packed along the width; raises an `InputError` if they are not binary."""
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
    """Open a file of version 5 at the values of the variable; raises nearly anything if it is damaged or something else."""
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}[_exactly(file, _HEADER_BYTES)[126:]]
        while head := file.read(8):
            kind, size = struct.unpack(f"{order}II", head)
            after = file.tell() + size
            stream: Stream = file
            if kind == _COMPRESSED:
                stream = io.BufferedReader(_Inflated(file, size), _BLOCK_BYTES)
                kind, _, _ = _tag(stream, order)
            if kind == _MATRIX and (found := _array(stream, order)):
                yield found
                return
            file.seek(after)
    raise _missing(path)


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


def _array(stream: Stream, order: str) -> _Variable | None:
    """Read the header of an array; None if it has another name than the variable."""
    flags, _ = struct.unpack(f"{order}II", _element(stream, order))
    shape = tuple(np.frombuffer(_element(stream, order), f"{order}i4").tolist())
    if _element(stream, order) != _VARIABLE.encode():
        return None
    kind, size, inline = _tag(stream, order)
    if flags & 0xFF not in _NUMBERS or flags & _COMPLEX or kind not in _DTYPES:
        raise ValueError("not an array of real numbers")
    dtype = np.dtype(f"{order}{_DTYPES[kind]}")
    if min(shape) < 0 or size != dtype.itemsize * math.prod(shape):
        raise ValueError(f"{size} bytes for {shape} values of {dtype}")
    values = stream if inline is None else io.BytesIO(inline)

    def read(start: int, stop: int) -> NDArray[Any]:
        of_frames = stop - start, shape[1], shape[0]
        return np.frombuffer(_exactly(values, math.prod(of_frames) * dtype.itemsize), dtype).reshape(of_frames)

    return _Variable(shape, read)


def _tag(stream: Stream, order: str) -> tuple[int, int, bytes | None]:
    """Return type and size of an element, and its bytes if there are at most four: they are part of the tag then."""
    head = _exactly(stream, 8)
    first, second = struct.unpack(f"{order}II", head)
    return (first & 0xFFFF, first >> 16, head[4:]) if first >> 16 else (first, second, None)


def _element(stream: Stream, order: str) -> bytes:
    _, size, inline = _tag(stream, order)
    if size > (_MOST_BYTES if inline is None else len(inline)):
        raise ValueError(f"{size} bytes are too many for a name or dimensions")
    return _exactly(stream, size + -size % 8)[:size] if inline is None else inline[:size]


def _exactly(stream: Stream, size: int) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise EOFError(f"{size} bytes were expected, there are {len(content)}")
    return content


class _Inflated(io.RawIOBase):
    """The unpacked content of a compressed element."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self._file, self._left, self._zlib = file, size, zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Unpack bytes into a buffer, and return their number; 0 at the end."""
        while not self._zlib.eof:
            packed = self._zlib.unconsumed_tail or self._file.read(min(self._left, _BLOCK_BYTES))
            if not self._zlib.unconsumed_tail:
                self._left -= len(packed)
            content = self._zlib.decompress(packed, len(buffer))
            if content:
                buffer[: len(content)] = content
                return len(content)
            if not packed:
                raise EOFError("a compressed element is cut short")
        return 0
