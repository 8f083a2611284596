"""Sources `packed-npy` and `npy`: frames in a .npy file, with eight pixels or with one pixel to a value."""

from __future__ import annotations

import json
import re
from functools import partial
from typing import Any, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photonpano import Arrived, Config, InputError, Location, Recognised, SourceContribution, SpecLocation, Url
from photonpano.photometry import packed_along_width, reversed_bits
from photonpano.reading import (
    Content,
    FrameFile,
    FrameLayout,
    NpyHeader,
    PackedFileSource,
    PixelOrder,
    ThreeChannels,
    any_npy_header,
    arrived_frames,
    as_written,
    frames_are_last,
    has_channels,
    is_gzip,
    objections,
    of_channel,
    other_order,
    packed_frames_are_last,
    require_frames,
    require_whole,
    sampled_frames,
    unpacked,
    unpacked_content,
)
from photonpano_core.sources.npy_values import NpyBits, NpySums, Values

_CHECKED = 16  # frames whose values are checked before a run
_PLAIN = re.compile(r"[\w./~+-]+")  # paths that YAML takes without quotes
_TYPES = {"bits": "bool", "sums": "numpy.uint16"}
_IN_COLOUR = ", in three channels"
_PATH = "the .npy file, or its URL; a file compressed with gzip is unpacked once, to a file beside it"


class PackedNpyConfig(Config):
    """A capture in one .npy file: uint8 (frames, height, ceil(width / 8)), as `numpy.packbits(cube, axis=-1)` makes it.

    In colour, the array is (frames, height, ceil(width / 8), 3): three channels, each packed along the width.
    """

    path: SpecLocation = Field(description=_PATH)
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")
    width: int | None = Field(
        None, ge=1, description="columns of a frame, in px; needed only if the width is not a multiple of eight"
    )
    channel: int | None = Field(
        None,
        ge=0,
        le=2,
        description="the one channel that is read of (frames, height, ceil(width / 8), 3): 0, 1 or 2; by default all, red, "
        "green and blue, for a panorama in colour",
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


class NpyConfig(Config):
    """A capture in one .npy file: integers or bool (frames, height, width), a pixel to a value.

    Bits in colour are (frames, height, width, 3): three channels.
    """

    path: SpecLocation = Field(description=_PATH)
    holds: Literal["bits", "sums"] = Field(
        description="bits: binary frames, of 0 and 1, of 0 and 255, or bool; sums: each frame is the sum of binary frames"
    )
    frames_per_sum: int | None = Field(
        None, ge=1, le=65535, description="number of binary frames in each sum; required for sums"
    )
    frame_axis: Literal["first", "last"] | None = Field(
        None,
        description="axis of the frames: first for (frames, height, width), last for (height, width, frames); by default "
        "first, and arrays that show that it is the last are refused",
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames (or sums) a second, in Hz; leave it out if unknown")

    @model_validator(mode="after")
    def _sums_have_a_number(self) -> Self:
        if self.holds == "sums" and self.frames_per_sum is None:
            raise ValueError("sums need frames_per_sum, the number of binary frames in each")
        if self.holds == "bits" and self.frames_per_sum is not None:
            raise ValueError("frames_per_sum is for sums; leave it out, or write holds: sums")
        return self


AnyConfig: TypeAlias = PackedNpyConfig | NpyConfig
AnySource: TypeAlias = PackedFileSource | NpyBits | NpySums | ThreeChannels


def _open(config: AnyConfig) -> AnySource:
    """Open a capture; raises an `InputError`, or an `OutputError` where a compressed file cannot be unpacked."""
    header = _whole_header(config)
    return _source(config, unpacked(config.path) if is_gzip(config.path) else config.path, header)


def _arrived(config: AnyConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    if (n_frames := arrived_frames(config.path)) is None:
        return Arrived(None)
    if isinstance(config, NpyConfig) and config.frame_axis == "last":
        raise InputError(f"{config.path} has its frames along the last axis, so that none is whole before all are written")
    header = _header(config)
    promised, *frame_shape = header.shape
    arrived = header._replace(shape=(n_frames, *frame_shape))
    return Arrived(_source(config, config.path, arrived) if n_frames else None, promised)


def _source(config: AnyConfig, path: Location, header: NpyHeader) -> AnySource:
    if isinstance(config, NpyConfig) and config.frames_per_sum is not None:
        return NpySums(Values(path, header, config.frame_axis == "last"), config.frames_per_sum, config.frame_rate_hz)

    def opened(channel: int | None) -> PackedFileSource | NpyBits:
        if isinstance(config, NpyConfig):
            return NpyBits(Values(path, header, config.frame_axis == "last"), config.frame_rate_hz, channel)
        file = FrameFile(path, header.shape[0], header.offset)
        return PackedFileSource([file], _layout(config, header, channel), config.frame_rate_hz)

    channel = config.channel if isinstance(config, PackedNpyConfig) else None
    return ThreeChannels(opened) if has_channels(path, header) and channel is None else opened(channel)


def _whole_header(config: AnyConfig) -> NpyHeader:
    """Return the header of a capture, of which nothing is missing and whose frames lie along the axis of the config."""
    path, header = config.path, _header(config)
    if not is_gzip(path):
        require_whole(path, header)
    if isinstance(config, NpyConfig) and config.frame_axis is None and _frames_are_last(path, header):
        raise InputError(
            f"{path} has its frames along the last axis of {header.shape}, where values are most alike; write "
            "frame_axis: last, or frame_axis: first if it is right"
        )
    return header


def _header(config: AnyConfig) -> NpyHeader:
    """Return the header of the capture, which may be incomplete; raise if it does not agree with the config."""
    path = config.path
    header = any_npy_header(path)
    if isinstance(config, PackedNpyConfig):
        _require_packed(config, header)
        return header
    if header.dtype.kind not in "bui":
        raise InputError(
            f"{path} holds {header.dtype} values; {config.holds} are bool or whole numbers: convert them with "
            f"cube.astype({_TYPES[config.holds]})"
        )
    if has_channels(path, header):
        if config.holds == "sums" or config.frame_axis == "last":
            key, remedy = "frame_axis: last", "numpy.moveaxis(numpy.load(path), 2, 0) to another file, and leave it out"
            if config.holds == "sums":
                key, remedy = "holds: sums", "one of them, such as numpy.load(path)[..., 1], to another file"
            raise InputError(f"{path} has three channels, in the shape {header.shape}, and {key} reads one only; save {remedy}")
    elif len(header.shape) != 3:
        raise InputError(
            f"{path} has the shape {header.shape}; a capture has 3 dimensions, frames, height and width, and one in colour a "
            "fourth, of 3 channels"
        )
    require_frames(path, header, "height, width, frames" if config.frame_axis == "last" else "frames, height, width")
    return header


def _require_packed(config: PackedNpyConfig, header: NpyHeader) -> None:
    path, channel = config.path, config.channel
    if header.dtype != np.uint8:
        raise InputError(f"{path} holds {header.dtype} values, not bytes of eight pixels; {_remedy(path, header)}")
    colour = has_channels(path, header)
    if len(header.shape) != 3 and not colour:
        raise InputError(
            f"{path} has the shape {header.shape}; a packed capture has 3 dimensions, frames, height and bytes of a row, and "
            "one of colour a fourth, of 3 channels"
        )
    require_frames(path, header, "frames, height, bytes of a row")
    if not colour and channel is not None:
        raise InputError(f"{path} has the shape {header.shape} and no channels; leave out channel: {channel}")
    _frame_shape(config, header)


def _layout(config: PackedNpyConfig, header: NpyHeader, channel: int | None) -> FrameLayout:
    bit_order = config.bit_order or "big"

    def grey(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return of_channel(stored, channel) if len(header.shape) == 4 else stored

    def along_width(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        columns = np.ascontiguousarray(grey(stored))
        return packed_along_width(reversed_bits(columns) if bit_order == "little" else columns)[:, : config.height]

    shapes = _frame_shape(config, header), header.shape[1:]
    if config.packed_along == "height":
        return FrameLayout(*shapes, to_rows=along_width)
    return FrameLayout(*shapes, bit_order, to_rows=grey if len(header.shape) == 4 else None)


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
            remedy = f"it seems not to be packed: write {_section(config.path, 'bits')}"
        raise InputError(
            f"{config.path} has rows of {n_columns} bytes, which hold a width of {8 * n_columns - 7} to {8 * n_columns}, not "
            f"{width}; {remedy}"
        )
    return n_rows, width


def _remedy(path: Location, header: NpyHeader) -> str:
    """Return the remedy for an array that is not uint8."""
    content = _contents(path, header)
    if content is None:
        return "pack frames of zeros and ones with numpy.packbits(cube, axis=-1)"
    return f"write {_section(path, content.holds, content.highest)}"


def _section(path: Location, holds: str, highest: int = 1) -> str:
    """Return the section of a spec that reads values; `highest` is the largest one seen."""
    written = str(path) if _PLAIN.fullmatch(str(path)) else json.dumps(str(path), ensure_ascii=False)
    if holds == "bits":
        return f"source: {{use: npy, with: {{path: {written}, holds: bits}}}}"
    keys = f"holds: sums, frames_per_sum: {highest}"
    return f"source: {{use: npy, with: {{path: {written}, {keys}}}}}, with the number of binary frames in a sum if it is larger"


def _contents(path: Location, header: NpyHeader) -> Content | None:
    """Return the content of an array of bool or whole numbers; None if it is something else, or bytes of eight pixels each."""
    if header.dtype.kind not in "bui" or min(header.shape, default=0) < 1 or header.fortran_order:
        return None
    if len(header.shape) != 3 and not has_channels(path, header):
        return None
    samples = _samples(path, header)
    return unpacked_content(samples) if samples else None


def _frames_are_last(path: Location, header: NpyHeader) -> bool:
    samples = _samples(path, header)
    return bool(samples) and len(header.shape) == 3 and frames_are_last(samples, header.shape)


def _require_order(config: PackedNpyConfig) -> None:
    """Refuse frames that are not packed, or in another order than by default, with the line of a spec that reads them."""
    header = _whole_header(config)
    path, samples = config.path, _samples(config.path, header, config.channel)
    if not samples or config.bit_order is not None or config.packed_along is not None:
        return
    if content := unpacked_content(samples):
        seen = f"all of {content.n_values:,} bytes sampled are 0 or {content.highest}"
        if content.holds == "sums":
            seen = f"neighbouring bytes are alike as numbers, up to {content.highest} in {content.n_values:,} sampled"
        raise InputError(f"{path} is not packed: {seen}; write {_section(path, content.holds, content.highest)}")
    frames_first = "numpy.moveaxis(numpy.load(path), -1, 0)"
    if packed_frames_are_last(samples, header.shape[:3], "pixels of a row"):
        raise _frames_last(path, header, "pixels of a row", f"save {frames_first} to another file")
    if packed_frames_are_last(samples, header.shape[:3], "pixels of a column"):
        remedy = f"save {frames_first} to another file and read that with packed_along: height"
        raise _frames_last(path, header, "pixels of a column", remedy)
    if other := other_order(samples):
        keys = " and ".join(f"{key}: {value}" for key, value in _keys_of(other.order).items())
        raise InputError(f"{path} is packed in another order: {other}; write {keys}, or bit_order: big if it is right")
    if packed_frames_are_last(samples, header.shape[:3], "frames"):
        frames_first = "numpy.moveaxis(numpy.unpackbits(numpy.load(path), axis=-1), -1, 0)"
        raise _frames_last(path, header, "frames", f"save numpy.packbits({frames_first}, axis=-1) to another file")


def _frames_last(path: Location, header: NpyHeader, a_byte_holds: str, remedy: str) -> InputError:
    return InputError(
        f"{path} has its frames along the last axis of {header.shape[:3]}, where values are most alike, and a byte holds eight "
        f"{a_byte_holds}; {remedy}, or write bit_order: big if it is right"
    )


def _samples(path: Location, header: NpyHeader, channel: int | None = None) -> list[NDArray[Any]]:
    samples = sampled_frames(path, header)
    return [of_channel(each, channel) for each in samples] if len(header.shape) == 4 else samples


def _keys_of(order: PixelOrder) -> dict[str, str]:
    """Return the keys of an order that differ from the defaults."""
    return {key: value for key, value in order._asdict().items() if value != getattr(PixelOrder(), key)}


def _require_values(config: NpyConfig) -> None:
    """Read some frames; raises what opening the capture and reading them raises. A compressed file is not unpacked for that."""
    if is_gzip(config.path):
        _whole_header(config)
        return
    with _open(config) as source:
        for span in source.info.spread(_CHECKED, 1):
            source.frames(span)


def _is_alone(path: Location) -> bool:
    """Return whether a path is a file that no transforms.json beside it describes, or a URL."""
    return isinstance(path, Url) or (path.is_file() and not (path.parent / "transforms.json").exists())


def _recognise_packed(path: Location) -> Recognised | None:
    if not _is_alone(path):
        return None
    try:
        header = _header(PackedNpyConfig(path=path))
    except InputError:
        return None
    keys: dict[str, Any] = {"path": as_written(path)}
    because = f"uint8 of shape {header.shape} in a .npy file{_IN_COLOUR if len(header.shape) == 4 else ''}"
    samples = _samples(path, header)
    if not samples:
        return Recognised(keys, because)
    shape = header.shape[:3]
    if unpacked_content(samples) or packed_frames_are_last(samples, shape, "pixels of a row"):
        return None
    if packed_frames_are_last(samples, shape, "pixels of a column"):
        return None
    if other := other_order(samples):
        return Recognised(keys | _keys_of(other.order), f"{because}, where {other}")
    return None if packed_frames_are_last(samples, shape, "frames") else Recognised(keys, because)


def _recognise_bits(path: Location) -> Recognised | None:
    """Take .npy files of bits. The number of frames in a sum stands in no file."""
    if not _is_alone(path):
        return None
    try:
        header = any_npy_header(path)
        content = _contents(path, header)
    except InputError:
        return None
    if content is None or content.holds != "bits":
        return None
    keys = {"path": as_written(path), "holds": "bits"}
    colour = _IN_COLOUR if len(header.shape) == 4 else ""
    because = f"{header.dtype} of shape {header.shape} in a .npy file{colour}, with the values 0 and {content.highest} only"
    if not _frames_are_last(path, header):
        return Recognised(keys, because)
    return Recognised(keys | {"frame_axis": "last"}, f"{because}, and values are most alike along the last axis")


_contribution = partial(
    SourceContribution,
    build=lambda config, _: _open(config),
    recognises_urls=True,
    suffixes=(".npy", ".gz"),
    arrived=_arrived,
)
PACKED_NPY = _contribution(
    name="packed-npy",
    summary="Binary frames in a .npy file, eight pixels to a byte, as from numpy.packbits",
    config=PackedNpyConfig,
    check=lambda config: objections(_require_order, config),
    recognise=_recognise_packed,
)
NPY = _contribution(
    name="npy",
    summary="Frames in a .npy file, a pixel to a value: zeros and ones, or sums of binary frames",
    config=NpyConfig,
    check=lambda config: objections(_require_values, config),
    recognise=_recognise_bits,
)
