"""Unpack .npy.gz files once, to a file beside them."""

from __future__ import annotations

import gzip
import logging
import os
import zlib
from functools import lru_cache
from pathlib import Path

from photonpano.atomic import atomic_path, require_space
from photonpano.errors import InputError
from photonpano.locks import hold
from photonpano.paths import Location, Url
from photonpano.reading.files import is_gzip, read_start, reading
from photonpano.reading.npy import NpyHeader, npy_header, read_npy_header

logger = logging.getLogger(__name__)

_BLOCK_BYTES = 1024**2


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
    checksum that the archive ends with. Until the process ends, it is locked for others who would remove it.

    Raises:
        InputError: the file is damaged, or holds something else.
        OutputError: the unpacked file cannot be written, or does not fit on its disk.
    """
    path = local(path)
    promised = gzipped_npy_header(path).file_bytes
    target = unpacked_path(path)
    if not _is_content(target, path, promised):
        require_space(target, promised)
        logger.warning("%s is unpacked to %s, once", path, target.name)
        with atomic_path(target) as temporary:
            _unpack(path, temporary, promised)
    hold(target)
    return target


def unpacked_path(path: Path) -> Path:
    """Return where a .npy.gz file is unpacked to."""
    return path.with_name(f"{path.name}.unpacked.npy")


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
