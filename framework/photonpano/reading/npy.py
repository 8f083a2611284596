"""Read and check headers of .npy and .npy.gz files, count the frames that are there, and unpack .npy.gz files once."""

from __future__ import annotations

import gzip
import logging
import math
import operator
import os
import zlib
from functools import lru_cache
from gzip import GzipFile
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from photonpano.errors import InputError
from photonpano.files.atomic import atomic_path, require_space
from photonpano.files.paths import Location, Url
from photonpano.reading.files import is_gzip, read_start, reading, size_of
from photonpano.reading.remote import read_range

_HEADER_BYTES = 4096  # bytes of a URL that are read for the header; that of a capture has 128
_SHORTEST_HEADER = 128  # bytes of the shortest header that numpy writes
_BLOCK_BYTES = 1024**2
_CHANNELS = 3


class NpyHeader(NamedTuple):
    """The header of a .npy file."""

    shape: tuple[int, ...]  # the shape of the array
    dtype: np.dtype[np.generic]  # the type of its values
    fortran_order: bool  # whether the first index varies fastest
    offset: int  # start of the data, in bytes

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


def has_channels(path: Location, header: NpyHeader) -> bool:
    """Return whether an array has a fourth axis, of three channels; an `InputError` if they lie along another axis."""
    if len(header.shape) == 4 and header.shape[3] != _CHANNELS and _CHANNELS in header.shape:
        axis = header.shape.index(_CHANNELS)
        raise InputError(
            f"{path} has three channels along axis {axis} of its shape {header.shape}; they belong last: save "
            f"numpy.moveaxis(numpy.load(path), {axis}, -1) to another file"
        )
    return len(header.shape) == 4 and header.shape[3] == _CHANNELS


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
    n_frames, *of_frame = header.shape or (0,)
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


logger = logging.getLogger(__name__)


def local(path: Location) -> Path:
    """Return the path of a compressed file; an `InputError` for a URL, of which it can only be read from its beginning."""
    if isinstance(path, Url):
        raise InputError(f"{path} is compressed with gzip, and cannot be read in parts; unpack it there, or download it")
    return path


def unpacked_start(path: Path, n_bytes: int) -> bytes:
    """Return the first bytes of a file, unpacked if it is compressed; none if it cannot be read."""
    if not is_gzip(path):
        return read_start(path, n_bytes)
    try:
        with gzip.open(path) as file:
            return file.read(n_bytes)
    except (OSError, EOFError, zlib.error):
        return b""


def any_npy_header(path: Location) -> NpyHeader:
    """Read the header of a .npy or .npy.gz file; raises as `npy_header` and `gzipped_npy_header`."""
    return gzipped_npy_header(path) if is_gzip(path) else npy_header(path)


def gzipped_npy_header(path: Location) -> NpyHeader:
    """Read the header of the array in a .npy.gz file, without its data.

    Raises:
        InputError: the file cannot be read, or holds something else; or it is a URL.
    """
    path = local(path)
    try:
        with gzip.open(path) as file:
            header = read_npy_header(file)
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged(path) from error
    if header is None:
        raise InputError(f"{path} holds no .npy file; compress one that numpy.save has written")
    return header


def unpacked(path: Location) -> Path:
    """Return the path of a .npy file with the content of a .npy.gz file.

    For `capture.npy.gz` it is `capture.npy.gz.unpacked.npy`. It is written, and a warning logged, unless it is there with the
    checksum that the archive ends with.

    Raises:
        InputError: the file is damaged, or holds something else.
        OutputError: the unpacked file cannot be written, or does not fit on its disk.
    """
    path = local(path)
    promised = gzipped_npy_header(path).file_bytes
    target = path.with_name(f"{path.name}.unpacked.npy")
    if not _is_content(target, path, promised):
        require_space(target, promised)
        logger.warning("%s is unpacked to %s, once", path, target.name)
        with atomic_path(target) as temporary:
            _unpack(path, temporary, promised)
    return target


def _is_content(target: Path, path: Path, promised: int) -> bool:
    """Return whether a file has the checksum that an archive ends with; one of several parts is always unpacked again."""
    if target.is_symlink() or not target.is_file() or target.stat().st_size != promised:
        return False
    with reading(path), path.open("rb") as archive:
        archive.seek(-8, os.SEEK_END)
        recorded = int.from_bytes(archive.read(4), "little")
    return _crc32(target, target.stat().st_ctime_ns) == recorded


@lru_cache(16)
def _crc32(path: Path, changed_ns: int) -> int:
    """Return the checksum of a file, which is read again if it has changed."""
    del changed_ns
    checksum = 0
    with reading(path), path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            checksum = zlib.crc32(block, checksum)
    return checksum


def _unpack(path: Path, target: Path, promised: int) -> None:
    """Unpack at most as many bytes as the header promises: a damaged file must not fill the disk."""
    size = 0
    with target.open("wb") as out, gzip.open(path) as file:
        while block := _next_block(path, file):
            size += len(block)
            if size > promised:
                break
            out.write(block)
    if size != promised:
        more = "more" if size > promised else f"{size}"
        raise InputError(
            f"{path} is damaged: the header of its array promises {promised} bytes, there are {more}; copy or record it again"
        )


def _next_block(path: Path, file: gzip.GzipFile) -> bytes:
    try:
        return file.read(_BLOCK_BYTES)
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged(path) from error


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is cut short or damaged: gzip cannot unpack it; copy it again")
