"""Read an array in a MATLAB file of version 5 to 7, in pieces.

The format is described in MathWorks, "MAT-File Level 5 File Format". scipy.io reads it too, but only whole arrays, and it ends
the process for some damaged files.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Stream: TypeAlias = IO[bytes] | io.BufferedReader

_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
# classes of numeric arrays; the others are cells, structures, objects, text and sparse matrices
_NUMBERS = range(6, 16)
_COMPLEX = 0x0800
_MOST_BYTES = 1024  # upper limit of the size of a name or of dimensions
_BLOCK_BYTES = 256 * 1024


@dataclass(frozen=True, slots=True)
class Mat5Array:
    """A numeric array whose values come next in a stream.

    Attributes:
        shape: its dimensions; the first varies fastest.
        dtype: type of the values in the file.
        stream: the stream of the values.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    stream: Stream

    def read(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Read the next values as an array of this shape, whose first dimension varies slowest."""
        size = math.prod(shape) * self.dtype.itemsize
        return np.frombuffer(_exactly(self.stream, size), self.dtype).reshape(shape)


@contextmanager
def mat5_array(path: Path, name: str) -> Iterator[Mat5Array | None]:
    """Open a file at the values of an array; None if it has no array of that name.

    Raises:
        Exception: of nearly any type, if the file is damaged or not a MATLAB file.
    """
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}[_exactly(file, _HEADER_BYTES)[126:]]
        found = None
        while found is None and (head := file.read(8)):
            kind, size = struct.unpack(f"{order}II", head)
            after = file.tell() + size
            stream: Stream = file
            if kind == _COMPRESSED:
                stream = io.BufferedReader(_Inflated(file, size), _BLOCK_BYTES)
                kind, _, _ = _tag(stream, order)
            found = _array(stream, order, name.encode()) if kind == _MATRIX else None
            if found is None:
                file.seek(after)
        yield found


def _array(stream: Stream, order: str, name: bytes) -> Mat5Array | None:
    """Read the header of an array; None if it has another name."""
    flags, _ = struct.unpack(f"{order}II", _element(stream, order))
    shape = tuple(np.frombuffer(_element(stream, order), f"{order}i4").tolist())
    if _element(stream, order) != name:
        return None
    kind, size, inline = _tag(stream, order)
    if flags & 0xFF not in _NUMBERS or flags & _COMPLEX or kind not in _DTYPES:
        raise ValueError("not an array of real numbers")
    dtype = np.dtype(f"{order}{_DTYPES[kind]}")
    if min(shape) < 0 or size != dtype.itemsize * math.prod(shape):
        raise ValueError(f"{size} bytes for {shape} values of {dtype}")
    return Mat5Array(shape, dtype, stream if inline is None else io.BytesIO(inline))


def _tag(stream: Stream, order: str) -> tuple[int, int, bytes | None]:
    """Return type and size of an element, and its bytes if there are at most four: they are part of the tag then."""
    head = _exactly(stream, 8)
    first, second = struct.unpack(f"{order}II", head)
    return (first & 0xFFFF, first >> 16, head[4:]) if first >> 16 else (first, second, None)


def _element(stream: Stream, order: str) -> bytes:
    """Read a short element."""
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
        """Return True."""
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
