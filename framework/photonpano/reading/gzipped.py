"""Unpack .npy.gz files once, to a file beside them."""

from __future__ import annotations

import gzip
import logging
import zlib
from pathlib import Path

from photonpano.atomic import atomic_path, require_space
from photonpano.errors import InputError
from photonpano.reading.files import read_start
from photonpano.reading.npy import NpyHeader, read_npy_header

logger = logging.getLogger(__name__)

_BLOCK_BYTES = 1024**2


def is_gzip(path: Path) -> bool:
    """Return whether a file is compressed with gzip, by its first bytes."""
    return read_start(path, 2) == b"\x1f\x8b"


def unpacked_start(path: Path, n_bytes: int) -> bytes:
    """Return the first bytes of a file, unpacked if it is compressed; none if it cannot be read."""
    if not is_gzip(path):
        return read_start(path, n_bytes)
    try:
        with gzip.open(path) as file:
            return file.read(n_bytes)
    except (OSError, EOFError, zlib.error):
        return b""


def gzipped_npy_header(path: Path) -> NpyHeader:
    """Read the header of the array in a .npy.gz file, without its data.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    try:
        with gzip.open(path) as file:
            header = read_npy_header(file)
    except (OSError, EOFError, zlib.error) as error:
        raise _damaged(path) from error
    if header is None:
        raise InputError(f"{path} holds no .npy file; compress one that numpy.save has written")
    return header


def unpacked(path: Path) -> Path:
    """Return the path of a .npy file with the content of a .npy.gz file.

    For `capture.npy.gz` it is `capture.npy.gz.unpacked.npy`. If that is missing or older, it is written, and a warning logged.

    Raises:
        InputError: the file is damaged, or holds something else.
        OutputError: the unpacked file cannot be written, or does not fit on its disk.
    """
    promised = gzipped_npy_header(path).file_bytes
    target = path.with_name(f"{path.name}.unpacked.npy")
    if target.is_file():
        made = target.stat()
        if made.st_mtime >= path.stat().st_mtime and made.st_size == promised:
            return target
    require_space(target, promised)
    logger.warning("%s is unpacked to %s, once", path, target.name)
    with atomic_path(target) as temporary:
        _unpack(path, temporary, promised)
    return target


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
