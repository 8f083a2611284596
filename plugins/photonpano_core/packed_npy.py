"""Source `packed-npy`: binary frames in a .npy file, eight pixels to a byte."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from photonpano import Arrived, Config, InputError, Location, Recognised, SourceContribution, SpecLocation, Url
from photonpano.photometry import packed_along_width, reversed_bits
from photonpano.reading import (
    FrameFile,
    FrameLayout,
    NpyHeader,
    PackedFileSource,
    PixelOrder,
    arrived_frames,
    as_written,
    gzipped_npy_header,
    is_gzip,
    npy_header,
    objections,
    other_order,
    packed_frames_are_last,
    require_frames,
    require_whole,
    sampled_frames,
    unpacked,
    unpacked_content,
    with_channel,
)
from photonpano_core.npy import contents_of, section_for

_CHANNELS = 3


class PackedNpyConfig(Config):
    """A capture in one .npy file: uint8 (frames, height, ceil(width / 8)), as `numpy.packbits(cube, axis=-1)` makes it."""

    path: SpecLocation = Field(
        description="the .npy file, or its URL; a file compressed with gzip is unpacked once, to a file beside it"
    )
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
    bit_order: Literal["big", "little"] | None = Field(
        None,
        description="big if the first of eight pixels is the highest bit of its byte, little if it is the lowest; by default "
        "big, and frames that show another order are refused",
    )
    packed_along: Literal["width", "height"] | None = Field(
        None,
        description="direction of the eight pixels of a byte: width, or height for (frames, ceil(height / 8), width); by "
        "default width, and frames that show another are refused",
    )
    height: int | None = Field(
        None,
        ge=1,
        description="rows of a frame, in px; needed only if frames are packed along the height, and it is not a multiple of "
        "eight",
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


def _arrived(config: PackedNpyConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    if (n_frames := arrived_frames(config.path)) is None:
        return Arrived(None)
    header, layout = _layout(config)
    file = FrameFile(config.path, n_frames, header.offset)
    source = PackedFileSource([file], layout, config.frame_rate_hz) if n_frames else None
    return Arrived(source, header.shape[0])


def _read(config: PackedNpyConfig) -> tuple[NpyHeader, FrameLayout]:
    """Return the header of the capture and the layout of its frames; raise if frames are missing."""
    header, layout = _layout(config)
    if not is_gzip(config.path):
        require_whole(config.path, header)
    return header, layout


def _layout(config: PackedNpyConfig) -> tuple[NpyHeader, FrameLayout]:
    path, channel = config.path, config.channel
    header = gzipped_npy_header(path) if is_gzip(path) else npy_header(path)
    if header.dtype != np.uint8:
        raise InputError(f"{path} holds {header.dtype} values, not bytes of eight pixels; {_remedy(path, header)}")
    colour = len(header.shape) == 4 and header.shape[3] == _CHANNELS
    if len(header.shape) != 3 and not colour:
        raise InputError(
            f"{path} has the shape {header.shape}; a packed capture has 3 dimensions, frames, height and bytes of a row, and "
            "one of colour a fourth, of 3 channels"
        )
    require_frames(path, header, "frames, height, bytes of a row")
    if colour and channel is None:
        raise InputError(f"{path} is a capture in colour, of shape {header.shape}; choose a channel: 0, 1 or 2")
    if not colour and channel is not None:
        raise InputError(f"{path} has the shape {header.shape} and no channels; leave out channel: {channel}")
    frame_shape = _frame_shape(config, header)
    if config.packed_along == "height":
        return header, FrameLayout(frame_shape, header.shape[1:], to_rows=lambda stored: _turned(stored, config))
    to_rows = None if channel is None else lambda stored: stored[..., channel]
    return header, FrameLayout(frame_shape, header.shape[1:], config.bit_order or "big", to_rows=to_rows)


def _turned(stored: NDArray[np.uint8], config: PackedNpyConfig) -> NDArray[np.uint8]:
    """Repack frames from along the height to along the width, the first pixel in the highest bit."""
    stored = stored if config.channel is None else np.ascontiguousarray(stored[..., config.channel])
    return packed_along_width(reversed_bits(stored) if config.bit_order == "little" else stored)[:, : config.height]


def _frame_shape(config: PackedNpyConfig, header: NpyHeader) -> tuple[int, int]:
    """Return the height and width of a frame; raise if they do not agree with the array."""
    n_rows, n_columns = header.shape[1:3]
    if config.packed_along == "height":
        height = 8 * n_rows if config.height is None else config.height
        width = n_columns if config.width is None else config.width
        if -(-height // 8) != n_rows:
            raise InputError(
                f"{config.path} has columns of {n_rows} bytes, which hold a height of {8 * n_rows - 7} to {8 * n_rows}, not "
                f"{height}; correct the height"
            )
        if width != n_columns:
            raise InputError(f"{config.path} has {n_columns} columns, not {width}; correct the width, or leave it out")
        return height, width
    if config.height not in (None, n_rows):
        raise InputError(f"{config.path} has {n_rows} rows, not {config.height}; correct the height, or leave it out")
    width = 8 * n_columns if config.width is None else config.width
    if -(-width // 8) != n_columns:
        remedy = "correct the width"
        if width == n_columns:
            remedy = f"it seems not to be packed: write {section_for(config.path, 'bits')}"
        raise InputError(
            f"{config.path} has rows of {n_columns} bytes, which hold a width of {8 * n_columns - 7} to {8 * n_columns}, not "
            f"{width}; {remedy}"
        )
    return n_rows, width


def _remedy(path: Location, header: NpyHeader) -> str:
    """Return what to do with an array that is not uint8."""
    content = contents_of(path, header)
    if content is None:
        return "pack frames of zeros and ones with numpy.packbits(cube, axis=-1)"
    return f"write {section_for(path, content.holds, content.highest)}"


def _require_layout(config: PackedNpyConfig) -> None:
    """Refuse frames that show that they are not packed, or in another order than is claimed by default.

    Raises:
        InputError: it is so, and the message has the line of the spec that reads them; or `_read` fails.
    """
    header, _ = _read(config)
    path, samples = config.path, _samples(config.path, header, config.channel)
    if not samples or config.bit_order is not None or config.packed_along is not None:
        return
    if content := unpacked_content(samples):
        seen = f"all of {content.n_values:,} bytes sampled are 0 or {content.highest}"
        if content.holds == "sums":
            seen = f"neighbouring bytes are alike as numbers, up to {content.highest} in {content.n_values:,} sampled"
        raise InputError(f"{path} is not packed: {seen}; write {section_for(path, content.holds, content.highest)}")
    if packed_frames_are_last(samples, header.shape[:3], "pixels"):
        raise _frames_last(path, header, "pixels", "numpy.moveaxis(numpy.load(path), -1, 0)")
    if other := other_order(samples):
        raise InputError(
            f"{path} is packed in another order: {other}; write {_keys_in_words(other.order)}, or bit_order: big if it is right"
        )
    if packed_frames_are_last(samples, header.shape[:3], "frames"):
        frames_first = "numpy.moveaxis(numpy.unpackbits(numpy.load(path), axis=-1), -1, 0)"
        raise _frames_last(path, header, "frames", f"numpy.packbits({frames_first}, axis=-1)")


def _frames_last(path: Location, header: NpyHeader, a_byte_holds: str, repacked: str) -> InputError:
    return InputError(
        f"{path} has its frames along the last axis of {header.shape[:3]}, where values are most alike, and a byte holds eight "
        f"{a_byte_holds}; save {repacked} to another file, or write bit_order: big if it is right"
    )


def _samples(path: Location, header: NpyHeader, channel: int | None) -> list[NDArray[np.uint8]]:
    samples: list[NDArray[Any]] = sampled_frames(path, header)
    return samples if channel is None else [each[..., channel] for each in samples]


def _keys_of(order: PixelOrder) -> dict[str, str]:
    """Return the keys of an order that differ from the defaults."""
    return {key: value for key, value in order._asdict().items() if value != getattr(PixelOrder(), key)}


def _keys_in_words(order: PixelOrder) -> str:
    return " and ".join(f"{key}: {value}" for key, value in _keys_of(order).items())


def _check(config: PackedNpyConfig) -> Sequence[str]:
    return objections(_require_layout, config)


def _recognise(path: Location) -> Recognised | None:
    """Take .npy files of packed frames, and not those that a transforms.json beside them describes."""
    if not isinstance(path, Url) and (not path.is_file() or (path.parent / "transforms.json").exists()):
        return None
    found = with_channel(lambda channel: _layout(PackedNpyConfig(path=path, channel=channel)))
    if found is None:
        return None
    (header, _), channel = found
    keys: dict[str, Any] = {"path": as_written(path)} | channel.keys
    because = f"uint8 of shape {header.shape} in a .npy file{channel.clause}"
    samples = _samples(path, header, channel.keys.get("channel"))
    if not samples:
        return Recognised(keys, because)
    if unpacked_content(samples) or packed_frames_are_last(samples, header.shape[:3], "pixels"):
        return None
    if other := other_order(samples):
        return Recognised(keys | _keys_of(other.order), f"{because}, where {other}")
    return None if packed_frames_are_last(samples, header.shape[:3], "frames") else Recognised(keys, because)


PACKED_NPY = SourceContribution(
    name="packed-npy",
    summary="Binary frames in a .npy file, eight pixels to a byte, as from numpy.packbits",
    config=PackedNpyConfig,
    build=lambda config, _: _open(config),
    check=_check,
    recognise=_recognise,
    recognises_urls=True,
    suffixes=(".npy", ".gz"),
    arrived=_arrived,
)
