"""Source `packed-npy`: binary frames in a .npy file, eight pixels to a byte."""

from __future__ import annotations

import math
import os
from threading import local
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field

from photonpano import Config, FrameSpan, InputError, Recognised, SourceContribution, SpecPath, StreamInfo
from photonpano.photometry import BinaryResponse, packed_counts

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from types import TracebackType

    from numpy.typing import NDArray


_READ_BYTES = 1024**2
"""So much is read at a time: a core's cache holds it until it is summed."""


class PackedNpyConfig(Config):
    """A capture in one .npy file: uint8 (frames, height, ceil(width / 8)), as `numpy.packbits(cube, axis=-1)` makes it."""

    path: SpecPath = Field(description="the .npy file")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")
    width: int | None = Field(
        None, ge=1, description="columns of a frame, in px; needed only where it is not eight times the bytes of a row"
    )


class PackedNpySource:
    """Binary frames of a .npy file, read a few at a time: a mapped file would fill the memory of the process.

    Raises:
        InputError: a file is missing or is not what the config says.
    """

    def __init__(self, config: PackedNpyConfig) -> None:
        header, width = _layout(config)
        n_frames, height, _ = header.shape
        self.info = StreamInfo(n_frames, height, width, config.frame_rate_hz)
        self.response = BinaryResponse()
        self.valid = np.ones(self.info.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self._frame = header.shape[1:]
        self._offset = header.offset
        self._path = config.path
        self._file = config.path.open("rb", buffering=0)
        self._buffers = local()

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        step = max(1, _READ_BYTES // math.prod(self._frame))
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for start in range(span.start, span.stop, step):
            packed_counts(self._read(FrameSpan(start, min(start + step, span.stop))), self.info.width, counts)
        return counts

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        self.info.require(span)
        return np.unpackbits(self._read(span), axis=-1, count=self.info.width)

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `photonpano.PackedSource`."""
        self.info.require(span)
        frames = self._read(span).copy()
        if self.info.width % 8:
            frames[..., -1] &= 0xFF << -self.info.width % 8 & 0xFF
        return frames

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def _read(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return packed frames, in a buffer of the thread that the next call overwrites."""
        frame_bytes = math.prod(self._frame)
        size = len(span) * frame_bytes
        buffer: NDArray[np.uint8] | None = getattr(self._buffers, "bytes", None)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers.bytes = np.empty(size, np.uint8)
        target = buffer[:size].data
        position = self._offset + span.start * frame_bytes
        while target:
            try:
                done = os.preadv(self._file.fileno(), [target], position)
            except OSError as error:
                raise InputError(f"cannot read {span} of {self._path}: {error.strerror}") from error
            if not done:
                raise InputError(f"{self._path} has become shorter: {span} are no longer in it; copy or record it again")
            target, position = target[done:], position + done
        return buffer[:size].reshape(len(span), *self._frame)

    def __enter__(self) -> PackedNpySource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class _Header(NamedTuple):
    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]
    fortran_order: bool
    offset: int


def _layout(config: PackedNpyConfig) -> tuple[_Header, int]:
    """Return the header of the capture and the width of its frames, after everything that can be told without its data."""
    path = config.path
    header = _header(path)
    if header.dtype != np.uint8:
        raise InputError(
            f"{path} holds {header.dtype} values, not packed uint8; pack frames of zeros and ones with "
            "numpy.packbits(cube, axis=-1)"
        )
    if len(header.shape) == 4:
        raise InputError(
            f"{path} has 4 dimensions {header.shape}, as colour captures have; save one channel, such as cube[..., 0]"
        )
    if len(header.shape) != 3:
        raise InputError(
            f"{path} has the shape {header.shape}; a packed capture has 3 dimensions: frames, height, bytes of a row"
        )
    if min(header.shape) < 1:
        raise InputError(f"{path} is empty: its shape is {header.shape} (frames, height, bytes of a row)")
    if header.fortran_order:
        raise InputError(f"{path} is stored in Fortran order; save it again with numpy.ascontiguousarray(cube)")
    _require_whole(path, header)

    row_bytes = header.shape[2]
    width = 8 * row_bytes if config.width is None else config.width
    if -(-width // 8) != row_bytes:
        remedy = "it seems not to be packed: use numpy.packbits(cube, axis=-1)" if width == row_bytes else "correct the width"
        raise InputError(
            f"{path} has rows of {row_bytes} bytes, which hold a width of {8 * row_bytes - 7} to {8 * row_bytes}, not {width}; "
            + remedy
        )
    return header, width


def _header(path: Path) -> _Header:
    try:
        with path.open("rb") as file:
            version = np.lib.format.read_magic(file)
            # Version 3 differs only for structured types, which no capture has.
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, fortran_order, dtype = read(file)
            return _Header(shape, dtype, fortran_order, file.tell())
    except FileNotFoundError as error:
        raise InputError(f"there is no file {path}; check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; name the .npy file in it") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except Exception as error:  # a damaged header makes numpy's parser raise nearly anything
        raise InputError(f"{path} is not a .npy file{_guess(path)}") from error


def _guess(path: Path) -> str:
    with path.open("rb") as file:
        start = file.read(4)
    if not start:
        return ": it is empty"
    if start.startswith(b"\x1f\x8b"):
        return ": it is compressed with gzip; unpack it with gunzip"
    if start.startswith(b"PK"):
        return ": it is an archive; save the array in it with numpy.save"
    if start.startswith(b"\x93NUM"):
        return " that can be read: its header is damaged; write it again"
    return ", by its first bytes; write it with numpy.save"


def _require_whole(path: Path, header: _Header) -> None:
    needed = header.offset + math.prod(header.shape) * header.dtype.itemsize
    size = path.stat().st_size
    if size < needed:
        raise InputError(
            f"{path} is cut short: its header {header.shape} promises {needed} bytes, the file has {size}; "
            "copy or record it again"
        )


def _check(config: PackedNpyConfig) -> Sequence[str]:
    """Do all but read the data."""
    try:
        _layout(config)
    except InputError as error:
        return (str(error),)
    return ()


def _recognise(path: Path) -> Recognised | None:
    if path.suffix != ".npy" or not path.is_file():
        return None
    try:
        header, _ = _layout(PackedNpyConfig(path=path))
    except InputError:
        return None
    return Recognised({"path": path}, f"uint8 of shape {header.shape} in a .npy file")


PACKED_NPY = SourceContribution(
    name="packed-npy",
    summary="Binary frames in a .npy file, eight pixels to a byte as numpy.packbits makes them",
    config=PackedNpyConfig,
    build=lambda config, _: PackedNpySource(config),
    check=_check,
    recognise=_recognise,
)
