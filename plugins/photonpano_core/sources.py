"""Sources `packed-npy`, `npy` and `packed-raw`: frames in a .npy file or in one without a header.

A value of `packed-npy` and `packed-raw` holds eight pixels, one of `npy` holds one: a bit, or a sum of bits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photonpano import (
    Arrived,
    Config,
    FrameSpan,
    InputError,
    Location,
    Piped,
    Recognised,
    SourceContribution,
    SpecLocation,
    StreamInfo,
    Url,
)
from photonpano.photometry import BinarySumResponse, packed_along_width, reversed_bits
from photonpano.reading import (
    BinarySource,
    BlockSource,
    Content,
    FrameFile,
    FrameLayout,
    NpyHeader,
    PackedFileSource,
    PixelOrder,
    StoredFrames,
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
    size_of,
    unpacked,
    unpacked_content,
)

_BLOCK_BYTES = 4 * 1024**2  # read at once of frames along the last axis, which are scattered over the file
_NO_BIT = "bits are 0 and 1, or 0 and 255; write holds: sums for sums, or use packed-npy for bytes of eight pixels"


class _Values:
    """Reads the values of frames in a .npy file, from any thread."""

    def __init__(self, path: Location, header: NpyHeader, frames_last: bool) -> None:
        """Take an array whose first or last axis is that of frames; raises an `InputError` if it is the last at a URL.

        If the frames are first, there may be a fourth axis, of channels.
        """
        n_frames, height, width, *_ = header.shape[-1:] + header.shape[:-1] if frames_last else header.shape
        self.path, self.shape, self._dtype = path, (n_frames, height, width), header.dtype
        self._stored: StoredFrames | None = None
        if not frames_last:
            stored_shape = *header.shape[1:-1], header.shape[-1] * header.dtype.itemsize
            self._stored = StoredFrames([FrameFile(path, n_frames, header.offset)], stored_shape)
        elif isinstance(path, Url):
            raise InputError(f"{path} has its frames along the last axis, scattered over the file; download it, and convert it")
        else:
            self._scattered = np.memmap(path, header.dtype, "r", header.offset, header.shape)

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield some frames of a span at a time, (n, H, W) or (n, H, W, 3), and their place in it.

        The next step may overwrite them.
        """
        if self._stored is not None:
            yield from ((place, stored.view(self._dtype)) for place, stored in self._stored.blocks(span))
            return
        frame_bytes = self.shape[1] * self.shape[2] * self._dtype.itemsize
        for block in span.blocks(max(1, _BLOCK_BYTES // frame_bytes)):
            values = np.moveaxis(self._scattered[..., block.start : block.stop], -1, 0)
            yield slice(block.start - span.start, block.stop - span.start), np.ascontiguousarray(values)

    def require(self, wrong: NDArray[np.bool_], values: NDArray[Any], first: int, remedy: str) -> None:
        """Raise for the first of the values, of frames from `first` on, that is wrong."""
        if wrong.any():
            frame, row, column, *_ = np.argwhere(wrong)[0].tolist()
            raise InputError(
                f"{self.path} holds the value {values[wrong][0]} in frame {first + frame}, row {row}, column {column}; {remedy}"
            )

    def close(self) -> None:
        """Close the file."""
        if self._stored is not None:
            self._stored.close()


class _NpyBits(BinarySource):
    """Binary frames, a pixel to a value; reading them raises an `InputError` for a value that is not a bit."""

    def __init__(self, values: _Values, frame_rate_hz: float | None, channel: int | None = None) -> None:
        """Take values, and the channel of those with channels, or None for what is lit in any."""
        n_frames, height, width = values.shape
        super().__init__(n_frames, FrameLayout((height, width), (height, -(-width // 8))), frame_rate_hz)
        self._values, self._channel = values, channel

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, packed: see `BinarySource`."""
        for place, values in self._values.blocks(span):
            if values.max() > 1 or values.min() < 0:
                wrong = (values != 0) & (values != 1) & (values != 255)
                self._values.require(wrong, values, span.start + place.start, _NO_BIT)
            lit = values != 0
            yield place, np.packbits(of_channel(lit, self._channel) if lit.ndim == 4 else lit, axis=2)

    def close(self) -> None:
        """Close the file."""
        self._values.close()


class _NpySums(BlockSource):
    """Sums of binary frames: a `photonpano.Source`; reading one with a value that is too large raises an `InputError`."""

    def __init__(self, values: _Values, binary_frames: int, frame_rate_hz: float | None) -> None:
        self.info = StreamInfo(*values.shape, frame_rate_hz, "intensity", binary_frames.bit_length())
        self.response = BinarySumResponse(binary_frames)
        self.valid = np.ones(self.info.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self._values = values

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the frames of a span, a few at a time: see `BlockSource`."""
        most = self.response.n
        for place, values in self._values.blocks(span):
            if values.max() > most or values.min() < 0:
                remedy = f"sums of frames_per_sum: {most} go from 0 to {most}; correct frames_per_sum"
                self._values.require((values < 0) | (values > most), values, span.start + place.start, remedy)
            yield place, values

    def close(self) -> None:
        """Close the file."""
        self._values.close()


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


_AnyConfig: TypeAlias = PackedNpyConfig | NpyConfig
_AnySource: TypeAlias = PackedFileSource | _NpyBits | _NpySums | ThreeChannels


def _open_npy(config: _AnyConfig) -> _AnySource:
    """Open a capture; raises an `InputError`, or an `OutputError` where a compressed file cannot be unpacked."""
    header = _whole_header(config)
    return _npy_source(config, unpacked(config.path) if is_gzip(config.path) else config.path, header)


def _arrived_npy(config: _AnyConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    if (n_frames := arrived_frames(config.path)) is None:
        return Arrived(None)
    if isinstance(config, NpyConfig) and config.frame_axis == "last":
        raise InputError(f"{config.path} has its frames along the last axis, so that none is whole before all are written")
    header = _header(config)
    promised, *frame_shape = header.shape
    arrived = header._replace(shape=(n_frames, *frame_shape))
    return Arrived(_npy_source(config, config.path, arrived) if n_frames else None, promised)


def _npy_source(config: _AnyConfig, path: Location, header: NpyHeader) -> _AnySource:
    if isinstance(config, NpyConfig) and config.frames_per_sum is not None:
        return _NpySums(_Values(path, header, config.frame_axis == "last"), config.frames_per_sum, config.frame_rate_hz)

    def opened(channel: int | None) -> PackedFileSource | _NpyBits:
        if isinstance(config, NpyConfig):
            return _NpyBits(_Values(path, header, config.frame_axis == "last"), config.frame_rate_hz, channel)
        file = FrameFile(path, header.shape[0], header.offset)
        return PackedFileSource([file], _layout(config, header, channel), config.frame_rate_hz)

    channel = config.channel if isinstance(config, PackedNpyConfig) else None
    return ThreeChannels(opened) if has_channels(path, header) and channel is None else opened(channel)


def _whole_header(config: _AnyConfig) -> NpyHeader:
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


def _header(config: _AnyConfig) -> NpyHeader:
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
    with _open_npy(config) as source:
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
    build=lambda config, _: _open_npy(config),
    recognises_urls=True,
    suffixes=(".npy", ".gz"),
    arrived=_arrived_npy,
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


_STANDARD_INPUT = "-"


class PackedRawConfig(Config):
    """Frames one after the other: packed rows from top to bottom, and nothing between frames."""

    path: Literal["-"] | SpecLocation = Field(
        description="the file, or its URL; or -, standard input, for `photonpano run --follow`"
    )
    height: int = Field(ge=1, le=65535, description="rows of a frame, in px")
    width: int = Field(ge=1, le=65535, description="columns of a frame, in px; a row takes ceil(width / 8) bytes")
    bit_order: Literal["big", "little"] = Field(
        "big", description="big if the first of eight pixels is the highest bit of its byte, little if it is the lowest"
    )
    header_bytes: int = Field(0, ge=0, description="bytes before the first frame, which are ignored")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")

    @property
    def layout(self) -> FrameLayout:
        """The order of the pixels of a frame in its bytes."""
        return FrameLayout((self.height, self.width), (self.height, -(-self.width // 8)), self.bit_order)


def _open_raw(config: PackedRawConfig) -> PackedFileSource:
    """Open a capture; raises an `InputError` if it is missing, has no frame, ends within one, or is standard input."""
    path, frame_bytes = _raw_file(config), config.layout.stored_bytes
    size = size_of(path)
    n_frames, rest = divmod(size - config.header_bytes, frame_bytes)
    if n_frames < 1:
        raise InputError(
            f"{path} has {size:,} bytes, and a frame of {config.height}x{config.width} px takes {frame_bytes:,}"
            f"{f' after {config.header_bytes:,} bytes' if config.header_bytes else ''}; correct height and width"
        )
    if rest:
        raise InputError(
            f"{path} ends within a frame: after {n_frames:,} frames of {frame_bytes:,} bytes come {rest:,} bytes more; correct "
            f"height and width, or cut off the rest with `truncate -s {size - rest} {path}`"
        )
    return _raw_source(config, path, n_frames)


def _arrived_raw(config: PackedRawConfig) -> Arrived | Piped:
    """Open the frames that are there of a file that is still being written, or describe the pipe that they come from."""
    frame_bytes = config.layout.stored_bytes
    if config.path == _STANDARD_INPUT:
        return Piped(config.header_bytes, frame_bytes)
    path = _raw_file(config)
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    n_frames = (size_of(path) - config.header_bytes) // frame_bytes if path.exists() else 0
    return Arrived(_raw_source(config, path, n_frames) if n_frames > 0 else None)


def _raw_file(config: PackedRawConfig) -> Location:
    if isinstance(config.path, str):
        raise InputError("frames on standard input are read once, as they arrive: run with --follow, or name a file")
    return config.path


def _raw_source(config: PackedRawConfig, path: Location, n_frames: int) -> PackedFileSource:
    return PackedFileSource([FrameFile(path, n_frames, config.header_bytes)], config.layout, config.frame_rate_hz)


PACKED_RAW = SourceContribution(
    name="packed-raw",
    summary="Binary frames in a file without any description, or on standard input, eight pixels to a byte",
    config=PackedRawConfig,
    build=lambda config, _: _open_raw(config),
    check=lambda config: () if config.path == _STANDARD_INPUT else objections(_open_raw, config),
    arrived=_arrived_raw,
)
