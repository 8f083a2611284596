"""Sources `packed-npy`, `npy` and `packed-raw`: frames in a .npy file or in one without a header.

A value of `packed-npy` and `packed-raw` holds eight pixels, one of `npy` holds one: a bit, or a sum of bits.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal, NamedTuple, Self, TypeAlias

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
    FrameFile,
    FrameLayout,
    NpyHeader,
    PackedFileSource,
    PixelOrder,
    StoredFrames,
    ThreeChannels,
    arrived_frames,
    as_written,
    eight_frames_are_first,
    frames_are_last,
    has_channels,
    is_array_file,
    is_matlab_file,
    npy_header,
    objections,
    of_channel,
    other_order,
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
_PATH = (
    "the .npy file, or its URL; a file compressed with gzip, or an array in an .npz, HDF5 or MATLAB file, is unpacked once, to "
    "a file beside it"
)
_ARRAY = "name of the array in an .npz, HDF5 or MATLAB file; needed if it has several"


class PackedNpyConfig(Config):
    """A capture in one .npy file: uint8 (frames, height, ceil(width / 8)), as `numpy.packbits(cube, axis=-1)` makes it.

    In colour, the array is (frames, height, ceil(width / 8), 3): three channels, each packed along the width.
    """

    path: SpecLocation = Field(description=_PATH)
    array: str | None = Field(None, description=_ARRAY)
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
    array: str | None = Field(None, description=_ARRAY)
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


def _unpacked(config: _AnyConfig) -> dict[str, Any]:
    """Return what changes in a config when its array is unpacked to a .npy file; nothing for a .npy file."""
    if not is_array_file(config.path):
        if config.array is None:
            return {}
        raise InputError(f"{config.path} is no .npz, HDF5 or MATLAB file; leave out array: {config.array}")
    axis = getattr(config, "frame_axis", None) if is_matlab_file(config.path) else None
    changed = {"path": unpacked(config.path, config.array, axis), "array": None}
    return changed if axis is None else changed | {"frame_axis": "first"}


def _open_npy(config: _AnyConfig) -> _AnySource:
    """Open a capture; raises an `InputError`, also where a file cannot be unpacked."""
    config = config.model_copy(update=_unpacked(config))
    return _npy_source(config, _whole_header(config))


def _arrived_npy(config: _AnyConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    if is_array_file(config.path):
        raise InputError(f"{config.path} is unpacked, so that no frame can be read before all are there; follow a .npy file")
    if (n_frames := arrived_frames(config.path)) is None:
        return Arrived(None)
    if isinstance(config, NpyConfig) and config.frame_axis == "last":
        raise InputError(f"{config.path} has its frames along the last axis, so that none is whole before all are written")
    header = _header(config)
    promised, *frame_shape = header.shape
    arrived = header._replace(shape=(n_frames, *frame_shape))
    return Arrived(_npy_source(config, arrived) if n_frames else None, promised)


def _npy_source(config: _AnyConfig, header: NpyHeader) -> _AnySource:
    path = config.path
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
    require_whole(path, header)
    if isinstance(config, NpyConfig) and config.frame_axis is None and len(header.shape) == 3:
        samples = sampled_frames(path, header)
        if samples and frames_are_last(samples, header.shape):
            raise InputError(
                f"{path} has its frames along the last axis of {header.shape}, where values are most alike; write "
                "frame_axis: last, or frame_axis: first if it is right"
            )
    return header


def _header(config: _AnyConfig) -> NpyHeader:
    """Return the header of the capture, which may be incomplete; raise if it does not agree with the config."""
    path, header = config.path, npy_header(config.path)
    axes = "frames, height, bytes of a row"
    if isinstance(config, PackedNpyConfig):
        if header.dtype != np.uint8 and len(header.shape) > 2 and min(header.shape) > 0:
            pack, seen = "pack frames of zeros and ones with numpy.packbits(cube != 0, axis=-1)", _seen(path, header)
            remedy = pack if seen is None else seen.remedy(path)
            raise InputError(f"{path} holds {header.dtype} values, not bytes of eight pixels; {remedy}")
    else:
        axes = "height, width, frames" if config.frame_axis == "last" else "frames, height, width"
        if header.dtype.kind not in "bui":
            raise InputError(
                f"{path} holds {header.dtype} values; {config.holds} are bool or whole numbers: convert them with "
                f"cube.astype({_TYPES[config.holds]})"
            )
    in_colour = has_channels(path, header)
    if len(header.shape) != 3 and not in_colour:
        raise InputError(
            f"{path} has the shape {header.shape}; a capture has 3 dimensions, {axes}, and in colour a fourth, of 3 channels"
        )
    require_frames(path, header, axes)
    if isinstance(config, PackedNpyConfig):
        if not in_colour and config.channel is not None:
            raise InputError(f"{path} has the shape {header.shape} and no channels; leave out channel: {config.channel}")
        _frame_shape(config, header)
    elif in_colour and (config.holds == "sums" or config.frame_axis == "last"):
        key = "holds: sums" if config.holds == "sums" else "frame_axis: last"
        raise InputError(
            f"{path} has three channels, in the shape {header.shape}, and {key} reads one only; save one of them, such as "
            "numpy.load(path)[..., 1], to another file"
        )
    return header


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
    packed_along, found = config.packed_along or "width", {"height": header.shape[1], "width": header.shape[2]}
    for key, stored in found.items():
        written: int | None = getattr(config, key)
        if key != packed_along and written not in (None, stored):
            raise InputError(f"{config.path} has a {key} of {stored}, not {written}; correct the {key}, or leave it out")
        if key == packed_along:
            found[key] = 8 * stored if written is None else written
            if -(-found[key] // 8) != stored:
                remedy = f"correct the {key}"
                if written == stored:
                    remedy = f"it seems not to be packed: write {_section(config.path, {'holds': 'bits'})}"
                raise InputError(
                    f"{config.path} has {stored} bytes along the {key}, which hold {8 * stored - 7} to {8 * stored} px, not "
                    f"{written}; {remedy}"
                )
    return found["height"], found["width"]


class _Seen(NamedTuple):
    """How the values of an array seem to be stored."""

    use: str  # the source that reads it, empty if none does
    keys: dict[str, Any]  # of this source, beside the path
    because: str = ""  # what shows it
    save: str = ""  # what to save to another file if no source reads it

    def remedy(self, path: Location) -> str:
        """Return what to write in a spec, or to save."""
        if self.use == "npy":
            larger = ", with the number of binary frames in a sum if it is larger" if self.keys["holds"] == "sums" else ""
            return f"write {_section(path, self.keys)}{larger}"
        keys = " and ".join(f"{key}: {value}" for key, value in self.keys.items())
        remedy = f"save {self.save} to another file, or write" if self.save else f"write {keys}, or"
        return f"{remedy} bit_order: big if it is right"


_EIGHT = {1: "pixels of a row", 0: "pixels of a column", 2: "frames"}  # what a byte may hold if the frames are the last axis


def _seen(path: Location, header: NpyHeader, channel: int | None = None) -> _Seen | None:
    """Return how an array of bool or whole numbers seems to be stored, by the likeness of neighbouring values."""
    if header.dtype.kind not in "bui" or min(header.shape, default=0) < 1 or header.fortran_order:
        return None
    in_colour = has_channels(path, header)
    if len(header.shape) != 3 and not in_colour:
        return None
    samples = [of_channel(each, channel) if in_colour else each for each in sampled_frames(path, header)]
    if not samples:
        return None
    shape = header.shape[:3]
    if content := unpacked_content(samples):
        keys: dict[str, Any] = {"holds": content.holds}
        because = f"all of {content.n_values:,} values sampled are 0 or {content.highest}"
        if content.holds == "sums":
            keys["frames_per_sum"] = content.highest
            because = f"neighbouring values are alike as numbers, up to {content.highest} in {content.n_values:,} sampled"
        if not in_colour and frames_are_last(samples, shape):
            return _Seen("npy", keys | {"frame_axis": "last"}, f"{because}, and most alike along the last axis of {shape}")
        return _Seen("npy", keys, because)
    if header.dtype != np.uint8:
        return None
    for axis, eight in _EIGHT.items():
        if axis == 2 and frames_are_last(samples, shape, axis) and eight_frames_are_first(samples):
            packed = "numpy.packbits(numpy.unpackbits(numpy.load(path), axis=0), axis=-1)"
            return _Seen("", {}, f"has eight frames in a byte, along the first axis of {shape}", packed)
        if frames_are_last(samples, shape, axis):
            frames_first = f"numpy.moveaxis(numpy.unpackbits(numpy.load(path), axis={axis}), -1, 0)"
            alike = f"has its frames along the last axis of {shape}, where values are most alike"
            return _Seen("", {}, f"{alike}, and a byte holds eight {eight}", f"numpy.packbits({frames_first}, axis=-1)")
    if other := other_order(samples):
        keys = {key: value for key, value in other.order._asdict().items() if value != getattr(PixelOrder(), key)}
        return _Seen("packed-npy", keys, str(other))
    return _Seen("packed-npy", {})


def _section(path: Location, keys: dict[str, Any]) -> str:
    """Return the section of a spec that reads values that are not packed."""
    written = str(path) if _PLAIN.fullmatch(str(path)) else json.dumps(str(path), ensure_ascii=False)
    return f"source: {{use: npy, with: {{path: {written}, {', '.join(f'{key}: {value}' for key, value in keys.items())}}}}}"


def _require_order(config: PackedNpyConfig) -> None:
    """Refuse frames that are not packed, or in another order than by default, with the line of a spec that reads them."""
    config = config.model_copy(update=_unpacked(config))
    header = _whole_header(config)
    if config.bit_order is not None or config.packed_along is not None:
        return
    seen = _seen(config.path, header, config.channel)
    if seen is not None and (seen.use != "packed-npy" or seen.keys):
        wrong = {"npy": "is not packed: ", "packed-npy": "is packed in another order: "}.get(seen.use, "")
        raise InputError(f"{config.path} {wrong}{seen.because}; {seen.remedy(config.path)}")


def _require_values(config: NpyConfig) -> None:
    """Read some frames; raises what opening the capture and reading them raises."""
    with _open_npy(config) as source:
        for span in source.info.spread(_CHECKED, 1):
            source.frames(span)


def _is_alone(path: Location) -> bool:
    """Return whether a path is a file that no transforms.json beside it describes, or a URL."""
    return isinstance(path, Url) or (path.is_file() and not (path.parent / "transforms.json").exists())


def _recognise(use: str, path: Location) -> Recognised | None:
    """Take .npy files that the source reads as their values seem to be stored; but no sums, whose number stands in no file."""
    if not _is_alone(path):
        return None
    try:
        stored = unpacked(path) if is_array_file(path) else path
        header = npy_header(stored)
        seen = _seen(stored, header)
        if seen is None and use == "packed-npy":  # too short to tell, or cut short
            _header(PackedNpyConfig(path=stored))
            seen = _Seen(use, {})
    except InputError:
        return None
    if seen is None or seen.use != use or seen.keys.get("holds") == "sums":
        return None
    colour = _IN_COLOUR if len(header.shape) == 4 else ""
    what = "a .npy file" if stored == path else "a file of arrays"
    because = f"{header.dtype} of shape {header.shape} in {what}{colour}{', where ' if seen.because else ''}{seen.because}"
    return Recognised({"path": as_written(path), **seen.keys}, because)


_contribution = partial(
    SourceContribution,
    build=lambda config, _: _open_npy(config),
    recognises_urls=True,
    suffixes=(".npy", ".gz", ".npz", ".h5", ".hdf5", ".mat"),
    arrived=_arrived_npy,
)
PACKED_NPY = _contribution(
    name="packed-npy",
    summary="Binary frames in a .npy file, eight pixels to a byte, as from numpy.packbits",
    config=PackedNpyConfig,
    check=lambda config: objections(_require_order, config),
    recognise=partial(_recognise, "packed-npy"),
)
NPY = _contribution(
    name="npy",
    summary="Frames in a .npy file, a pixel to a value: zeros and ones, or sums of binary frames",
    config=NpyConfig,
    check=lambda config: objections(_require_values, config),
    recognise=partial(_recognise, "npy"),
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
    suffixes=(".bin", ".raw"),
)
