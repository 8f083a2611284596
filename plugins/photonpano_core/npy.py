"""Source `npy`: frames in a .npy file, a pixel to a value: zeros and ones, or sums of binary frames."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photonpano import (
    Arrived,
    Config,
    FrameSpan,
    InputError,
    Location,
    Recognised,
    SourceContribution,
    SpecLocation,
    StreamInfo,
    Url,
)
from photonpano.photometry import BinarySumResponse
from photonpano.reading import (
    BinarySource,
    Closing,
    Content,
    FrameLayout,
    NpyHeader,
    OpenFiles,
    Pieces,
    arrived_frames,
    as_written,
    frames_are_last,
    gzipped_npy_header,
    is_gzip,
    npy_header,
    objections,
    require_frames,
    require_whole,
    sampled_frames,
    unpacked,
    unpacked_content,
)

_READ_BYTES = 4 * 1024**2  # bytes of the frames that are read at once


_CHECKED = 16  # frames whose values are checked before a run
_PLAIN = re.compile(r"[\w./~+-]+")  # paths that YAML takes without quotes
_NO_BIT = "bits are 0 and 1, or 0 and 255; write holds: sums for sums, or use packed-npy for bytes of eight pixels"


class NpyConfig(Config):
    """A capture in one .npy file: integers or bool (frames, height, width), a pixel to a value."""

    path: SpecLocation = Field(
        description="the .npy file, or its URL; a file compressed with gzip is unpacked once, to a file beside it"
    )
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


class _Values:
    """Reads the values of frames in a .npy file, from any thread."""

    def __init__(self, path: Location, header: NpyHeader, frames_last: bool) -> None:
        n_frames, height, width = header.shape[-1:] + header.shape[:-1] if frames_last else header.shape
        self.path = path
        self.shape = n_frames, height, width
        self.frame_bytes = height * width * header.dtype.itemsize
        self.files = OpenFiles()
        self._header = header
        # Frames along the last axis are scattered over the file.
        self._scattered = None
        if frames_last:
            if isinstance(path, Url):
                raise InputError(
                    f"{path} has its frames along the last axis, scattered over the file; download it, and convert it"
                )
            self._scattered = np.memmap(path, header.dtype, "r", header.offset, header.shape)
        self._remote = None
        if isinstance(path, Url):
            self._remote = Pieces([*range(0, n_frames, max(1, _READ_BYTES // self.frame_bytes)), n_frames], self._stored)

    def blocks(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the frames of a span, (n, H, W), a few at a time, and their places in the span."""
        if self._remote is not None:
            shape = self.shape[1:]
            yield from ((place, stored.view(self._header.dtype).reshape(-1, *shape)) for place, stored in self._remote.of(span))
            return
        for block in span.blocks(max(1, _READ_BYTES // self.frame_bytes)):
            yield slice(block.start - span.start, block.stop - span.start), self._read(block)

    def _read(self, span: FrameSpan) -> NDArray[Any]:
        if self._scattered is not None:
            return np.ascontiguousarray(np.moveaxis(self._scattered[..., span.start : span.stop], -1, 0))
        return self._stored(span).view(self._header.dtype).reshape(-1, *self.shape[1:])

    def _stored(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the bytes of the frames of a span: (n, bytes of a frame)."""
        stored = np.empty((len(span), self.frame_bytes), np.uint8)
        self.files.read(self.path, self._header.offset + span.start * self.frame_bytes, stored)
        return stored

    def require(self, wrong: NDArray[np.bool_], values: NDArray[Any], first: int, remedy: str) -> None:
        """Raise for the first of the values, of frames from `first` on, that is wrong."""
        if wrong.any():
            frame, row, column = np.argwhere(wrong)[0].tolist()
            raise InputError(
                f"{self.path} holds the value {values[frame, row, column]} in frame {first + frame}, row {row}, column "
                f"{column}; {remedy}"
            )

    def close(self) -> None:
        """Close the file."""
        self.files.close()
        if self._remote is not None:
            self._remote.close()


class NpyBits(BinarySource):
    """Binary frames, a pixel to a value.

    Raises:
        InputError: when frames are read: a value is not a bit.
    """

    def __init__(self, values: _Values, frame_rate_hz: float | None) -> None:
        n_frames, height, width = values.shape
        super().__init__(n_frames, FrameLayout((height, width), (height, -(-width // 8))), frame_rate_hz)
        self._values = values

    def pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[np.uint8]]]:
        """Yield the frames of a span, packed: see `BinarySource`."""
        for place, values in self._values.blocks(span):
            if values.max() > 1 or values.min() < 0:
                wrong = (values != 0) & (values != 1) & (values != 255)
                self._values.require(wrong, values, span.start + place.start, _NO_BIT)
            yield place, np.packbits(values != 0, axis=2)

    def close(self) -> None:
        """Close the file."""
        self._values.close()


class NpySums(Closing):
    """Sums of binary frames: a `photonpano.Source`.

    Raises:
        InputError: when frames are read: a value cannot be a sum of so many binary frames.
    """

    def __init__(self, values: _Values, binary_frames: int, frame_rate_hz: float | None) -> None:
        self.info = StreamInfo(*values.shape, frame_rate_hz, "intensity", binary_frames.bit_length())
        self.response = BinarySumResponse(binary_frames)
        self.valid = np.ones(self.info.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self._values = values

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for _, sums in self._pieces(span):
            counts += sums.sum(axis=0, dtype=np.uint32)
        return counts

    def frames(self, span: FrameSpan) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Return the frames of a span: (n, H, W), each the sum of binary frames."""
        self.info.require(span)
        shape = len(span), *self.info.frame_shape
        frames = np.empty(shape, np.uint8) if self.info.bit_depth <= 8 else np.empty(shape, np.uint16)
        for place, sums in self._pieces(span):
            frames[place] = sums
        return frames

    def _pieces(self, span: FrameSpan) -> Iterator[tuple[slice, NDArray[Any]]]:
        most = self.response.n
        for place, values in self._values.blocks(span):
            if values.max() > most or values.min() < 0:
                remedy = f"sums of frames_per_sum: {most} go from 0 to {most}; correct frames_per_sum"
                self._values.require((values < 0) | (values > most), values, span.start + place.start, remedy)
            yield place, values

    def close(self) -> None:
        """Close the file."""
        self._values.close()


def contents_of(path: Location, header: NpyHeader) -> Content | None:
    """Return what the values of an array are, if they are bool or whole numbers, and not bytes of eight pixels each."""
    if header.dtype.kind not in "bui" or len(header.shape) != 3 or min(header.shape) < 1 or header.fortran_order:
        return None
    samples = sampled_frames(path, header)
    return unpacked_content(samples) if samples else None


def section_for(path: Location, holds: str, highest: int = 1) -> str:
    """Return the section of a spec that reads such a capture; `highest` is the largest value that was seen in it."""
    written = str(path) if _PLAIN.fullmatch(str(path)) else json.dumps(str(path), ensure_ascii=False)
    if holds == "bits":
        return f"source: {{use: npy, with: {{path: {written}, holds: bits}}}}"
    keys = f"holds: sums, frames_per_sum: {highest}"
    return f"source: {{use: npy, with: {{path: {written}, {keys}}}}}, with the number of binary frames in a sum if it is larger"


def _header(config: NpyConfig) -> NpyHeader:
    """Return the header of the capture.

    Raises:
        InputError: the file is missing, damaged, or does not agree with the config.
    """
    path, header = config.path, _checked_header(config)
    if not is_gzip(path):
        require_whole(path, header)
    if config.frame_axis is None and _frames_are_last(path, header):
        raise InputError(
            f"{path} has its frames along the last axis of {header.shape}, where values are most alike; write "
            "frame_axis: last, or frame_axis: first if it is right"
        )
    return header


def _checked_header(config: NpyConfig) -> NpyHeader:
    """Return the header of the capture, which may be incomplete. Raises as `_header` does."""
    path = config.path
    header = gzipped_npy_header(path) if is_gzip(path) else npy_header(path)
    if header.dtype.kind not in "bui":
        raise InputError(
            f"{path} holds {header.dtype} values; {config.holds} are bool or whole numbers: convert them with "
            f"cube.astype({_TYPES[config.holds]})"
        )
    if len(header.shape) != 3:
        raise InputError(f"{path} has the shape {header.shape}; a capture has 3 dimensions, frames, height and width")
    require_frames(path, header, "height, width, frames" if config.frame_axis == "last" else "frames, height, width")
    return header


_TYPES = {"bits": "bool", "sums": "numpy.uint16"}


def _frames_are_last(path: Location, header: NpyHeader) -> bool:
    samples = sampled_frames(path, header)
    return bool(samples) and frames_are_last(samples, header.shape)


def _open(config: NpyConfig) -> NpyBits | NpySums:
    header = _header(config)
    path = unpacked(config.path) if is_gzip(config.path) else config.path
    return _source_of(_Values(path, header, config.frame_axis == "last"), config)


def _source_of(values: _Values, config: NpyConfig) -> NpyBits | NpySums:
    if config.frames_per_sum is None:
        return NpyBits(values, config.frame_rate_hz)
    return NpySums(values, config.frames_per_sum, config.frame_rate_hz)


def _arrived(config: NpyConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    if (n_frames := arrived_frames(config.path)) is None:
        return Arrived(None)
    if config.frame_axis == "last":
        raise InputError(f"{config.path} has its frames along the last axis, so that none is whole before all are written")
    header = _checked_header(config)
    promised, *frame_shape = header.shape
    if not n_frames:
        return Arrived(None, promised)
    values = _Values(config.path, header._replace(shape=(n_frames, *frame_shape)), frames_last=False)
    return Arrived(_source_of(values, config), promised)


def _read_some(config: NpyConfig) -> None:
    """Read some frames; raises what opening the capture and reading them raises. A compressed file is not unpacked for that."""
    _header(config)
    if is_gzip(config.path):
        return
    with _open(config) as source:
        for span in source.info.spread(_CHECKED, 1):
            source.frames(span)


def _check(config: NpyConfig) -> Sequence[str]:
    return objections(_read_some, config)


def _recognise(path: Location) -> Recognised | None:
    """Take .npy files of bits. The number of frames in a sum stands in no file."""
    if not isinstance(path, Url) and (not path.is_file() or (path.parent / "transforms.json").exists()):
        return None
    try:
        header = gzipped_npy_header(path) if is_gzip(path) else npy_header(path)
        content = contents_of(path, header)
    except InputError:
        return None
    if content is None or content.holds != "bits":
        return None
    keys = {"path": as_written(path), "holds": "bits"}
    because = f"{header.dtype} of shape {header.shape} in a .npy file, with the values 0 and {content.highest} only"
    if not _frames_are_last(path, header):
        return Recognised(keys, because)
    return Recognised(keys | {"frame_axis": "last"}, f"{because}, and values are most alike along the last axis")


NPY = SourceContribution(
    name="npy",
    summary="Frames in a .npy file, a pixel to a value: zeros and ones, or sums of binary frames",
    config=NpyConfig,
    build=lambda config, _: _open(config),
    check=_check,
    recognise=_recognise,
    recognises_urls=True,
    suffixes=(".npy", ".gz"),
    arrived=_arrived,
)
