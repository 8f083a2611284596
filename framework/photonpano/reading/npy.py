"""Read and check headers of .npy files, without their data, and count the frames of those that are still being written."""

from __future__ import annotations

import math
import operator
from gzip import GzipFile
from io import BytesIO
from typing import IO, NamedTuple

import numpy as np

from photonpano.errors import InputError
from photonpano.paths import Location, Url
from photonpano.reading.files import is_gzip, read_start, reading, size_of
from photonpano.reading.remote import read_range

_HEADER_BYTES = 4096  # bytes of a URL that are read for the header; that of a capture has 128
_SHORTEST_HEADER = 128  # bytes of the shortest header that numpy writes


class NpyHeader(NamedTuple):
    """The header of a .npy file.

    Attributes:
        shape: the shape of the array.
        dtype: the type of its values.
        fortran_order: whether the first index varies fastest.
        offset: start of the data, in bytes.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    fortran_order: bool
    offset: int

    @property
    def file_bytes(self) -> int:
        """The size of a complete file."""
        return self.offset + math.prod(self.shape) * self.dtype.itemsize


def npy_header(path: Location) -> NpyHeader:
    """Read the header of a .npy file; an `InputError` if it cannot be read, or is something else."""
    if isinstance(path, Url):
        start = read_range(path, 0, _HEADER_BYTES)
        header = read_npy_header(BytesIO(start))
    elif path.is_dir():
        raise InputError(f"{path} is a folder; name the .npy file in it")
    else:
        with reading(path), path.open("rb") as file:
            header = read_npy_header(file)
    if header is None:
        raise InputError(f"{path} is not a .npy file{_guess(read_start(path, 4))}")
    return header


def read_npy_header(file: IO[bytes] | GzipFile) -> NpyHeader | None:
    """Return the header at the beginning of an open file; None if it is damaged or missing. An `OSError` passes."""
    try:
        version = np.lib.format.read_magic(file)
        # Version 3 differs only for structured types, which no capture has.
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran_order, dtype = read(file)
        return NpyHeader(tuple(map(operator.index, shape)), dtype, fortran_order, file.tell())
    except OSError:
        raise
    except Exception:  # a damaged header makes numpy's parser raise nearly anything
        return None


def require_whole(path: Location, header: NpyHeader) -> None:
    """Raise an `InputError` for a .npy file that is shorter than its header promises."""
    size = size_of(path)
    if size < header.file_bytes:
        raise InputError(
            f"{path} is cut short: its header {header.shape} promises {header.file_bytes} bytes, the file has {size}; "
            "copy or record it again"
        )


def require_frames(path: Location, header: NpyHeader, axes: str) -> None:
    """Raise an `InputError` for an array without values, or not in C order; `axes` is such as "frames, height, width"."""
    if min(header.shape) < 1:
        raise InputError(f"{path} is empty: its shape is {header.shape} ({axes})")
    if header.fortran_order:
        raise InputError(f"{path} is stored in Fortran order; save it again with numpy.ascontiguousarray(cube)")


def arrived_frames(path: Location) -> int | None:
    """Return how many whole frames of a .npy file are there that is still being written: None if not even its header is.

    Raises:
        InputError: the file cannot be read, is something else, or cannot be read before it is whole.
    """
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    if is_gzip(path):
        raise InputError(f"{path} is compressed, so that no frame can be read before all are there; follow a .npy file")
    if not path.exists() or size_of(path) < _SHORTEST_HEADER:
        return None
    header = npy_header(path)
    n_frames, *of_frame = header.shape
    frame_bytes = math.prod(of_frame) * header.dtype.itemsize
    return min(n_frames, (size_of(path) - header.offset) // frame_bytes) if frame_bytes else 0


def _guess(start: bytes) -> str:
    if not start:
        return ": it is empty"
    if start.startswith(b"\x1f\x8b"):
        return ": it is compressed with gzip; unpack it with gunzip"
    if start.startswith(b"PK"):
        return ": it is an archive; save the array in it with numpy.save"
    if start.startswith(b"\x93NUM"):
        return " that can be read: its header is damaged; write it again"
    return ", by its first bytes; write it with numpy.save"
