"""Source `packed-npy`: binary frames in a .npy file, eight pixels to a byte."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pydantic import Field

from photonpano import Config, InputError, Recognised, SourceContribution, SpecPath
from photonpano.reading import (
    FrameFile,
    FrameLayout,
    NpyHeader,
    PackedFileSource,
    gzipped_npy_header,
    is_gzip,
    npy_header,
    objections,
    require_frames,
    require_whole,
    unpacked,
    unpacked_start,
)

_CHANNELS = 3
_GREEN = 1
_SAMPLE_BYTES = 64 * 1024
"""Bytes of the data that are read to distinguish packed frames from unpacked ones."""


class PackedNpyConfig(Config):
    """A capture in one .npy file: uint8 (frames, height, ceil(width / 8)), as `numpy.packbits(cube, axis=-1)` makes it."""

    path: SpecPath = Field(description="the .npy file; a file compressed with gzip is unpacked once, to a file beside it")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")
    width: int | None = Field(
        None, ge=1, description="columns of a frame, in px; needed only if the width is not a multiple of eight"
    )
    channel: int | None = Field(
        None,
        ge=0,
        le=2,
        description="channel of a colour capture (frames, height, ceil(width / 8), 3): 0, 1 or 2; leave it out for "
        "other captures",
    )


def _open(config: PackedNpyConfig) -> PackedFileSource:
    """Open a capture.

    Raises:
        InputError: the file is missing, or does not agree with the config.
        OutputError: a compressed file cannot be unpacked.
    """
    header, layout = _read(config)
    path = unpacked(config.path) if is_gzip(config.path) else config.path
    file = FrameFile(path, header.shape[0], header.offset)
    return PackedFileSource([file], layout, config.frame_rate_hz)


def _read(config: PackedNpyConfig) -> tuple[NpyHeader, FrameLayout]:
    """Return the header of the capture and the layout of its frames; raise if frames are missing."""
    header, layout = _layout(config)
    if not is_gzip(config.path):
        require_whole(config.path, header)
    return header, layout


def _layout(config: PackedNpyConfig) -> tuple[NpyHeader, FrameLayout]:
    path = config.path
    header = gzipped_npy_header(path) if is_gzip(path) else npy_header(path)
    if header.dtype != np.uint8:
        raise InputError(
            f"{path} holds {header.dtype} values, not packed uint8; pack frames of zeros and ones with "
            "numpy.packbits(cube, axis=-1)"
        )
    colour = len(header.shape) == 4 and header.shape[3] == _CHANNELS
    if len(header.shape) != 3 and not colour:
        raise InputError(
            f"{path} has the shape {header.shape}; a packed capture has 3 dimensions, frames, height and bytes of a row, and "
            "one of colour a fourth, of 3 channels"
        )
    require_frames(path, header, "frames, height, bytes of a row")
    if colour and config.channel is None:
        raise InputError(f"{path} is a capture in colour, of shape {header.shape}; choose a channel: 0, 1 or 2")
    if not colour and config.channel is not None:
        raise InputError(f"{path} has the shape {header.shape} and no channels; leave out channel: {config.channel}")

    height, row_bytes = header.shape[1:3]
    width = 8 * row_bytes if config.width is None else config.width
    if -(-width // 8) != row_bytes:
        remedy = "it seems not to be packed: use numpy.packbits(cube, axis=-1)" if width == row_bytes else "correct the width"
        raise InputError(
            f"{path} has rows of {row_bytes} bytes, which hold a width of {8 * row_bytes - 7} to {8 * row_bytes}, not {width}; "
            + remedy
        )
    channel = config.channel
    to_rows = None if channel is None else lambda stored: stored[..., channel]
    return header, FrameLayout((height, width), header.shape[1:], to_rows=to_rows)


def _check(config: PackedNpyConfig) -> Sequence[str]:
    return objections(_read, config)


def _recognise(path: Path) -> Recognised | None:
    """Take .npy files of packed frames, and not those that a transforms.json beside them describes."""
    if not path.is_file() or (path.parent / "transforms.json").exists():
        return None
    for channel in (None, _GREEN):
        try:
            header, _ = _layout(PackedNpyConfig(path=path, channel=channel))
        except InputError:
            continue
        if max(unpacked_start(path, header.offset + _SAMPLE_BYTES)[header.offset :], default=0) == 1:
            return None  # zeros and ones: a pixel to a byte
        because = f"uint8 of shape {header.shape} in a .npy file"
        if channel is None:
            return Recognised({"path": str(path)}, because)
        return Recognised({"path": str(path), "channel": channel}, f"{because}, of whose channels the middle one is used")
    return None


PACKED_NPY = SourceContribution(
    name="packed-npy",
    summary="Binary frames in a .npy file, eight pixels to a byte, as from numpy.packbits",
    config=PackedNpyConfig,
    build=lambda config, _: _open(config),
    check=_check,
    recognise=_recognise,
    suffixes=(".npy", ".gz"),
)
