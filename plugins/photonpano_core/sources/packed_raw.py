"""Source `packed-raw`: binary frames in a file that says nothing about them, or on standard input, eight pixels to a byte."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from photonpano import Arrived, Config, InputError, Location, Piped, SourceContribution, SpecLocation, Url
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource, objections, size_of

STANDARD_INPUT = "-"


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


def _open(config: PackedRawConfig) -> PackedFileSource:
    """Open a capture; raises an `InputError` if it is missing, has no frame, ends within one, or is standard input."""
    path, frame_bytes = _file(config), config.layout.stored_bytes
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
    return _source(config, path, n_frames)


def _arrived(config: PackedRawConfig) -> Arrived | Piped:
    """Open the frames that are there of a file that is still being written, or describe the pipe that they come from."""
    frame_bytes = config.layout.stored_bytes
    if config.path == STANDARD_INPUT:
        return Piped(config.header_bytes, frame_bytes)
    path = _file(config)
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    n_frames = (size_of(path) - config.header_bytes) // frame_bytes if path.exists() else 0
    return Arrived(_source(config, path, n_frames) if n_frames > 0 else None)


def _file(config: PackedRawConfig) -> Location:
    if isinstance(config.path, str):
        raise InputError("frames on standard input are read once, as they arrive: run with --follow, or name a file")
    return config.path


def _source(config: PackedRawConfig, path: Location, n_frames: int) -> PackedFileSource:
    return PackedFileSource([FrameFile(path, n_frames, config.header_bytes)], config.layout, config.frame_rate_hz)


PACKED_RAW = SourceContribution(
    name="packed-raw",
    summary="Binary frames in a file without any description, or on standard input, eight pixels to a byte",
    config=PackedRawConfig,
    build=lambda config, _: _open(config),
    check=lambda config: () if config.path == STANDARD_INPUT else objections(_open, config),
    arrived=_arrived,
)
