"""Source `spike-dat`: .dat files of spike cameras, whose pixels fire when the light they have gathered reaches a threshold."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from photonpano import Arrived, Config, InputError, Location, Recognised, SourceContribution, SpecLocation, Url
from photonpano.photometry import IntensityResponse
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource, as_written, objections, read_start, size_of
from photonpano_sensors.bin_files import correlation

# Rows and columns of the cameras and simulators whose files are public.
_SHAPES = ((250, 400), (1000, 1000), (480, 640), (360, 640), (396, 640))
# The flux is spikes per pixel per frame. A pixel keeps the light that is left when it fires, so that spikes are proportional
# to the light. Their variance is taken to be their number, as of single photons, which is too large: that of a visit of many
# may be a fifth. In the dark, what is left at the ends of a visit counts: 1/6 spike squared, here in 200 frames.
RESPONSE = IntensityResponse(photons_per_level=1.0, black_level=0.0, saturation_level=1.0, read_noise=(1 / 6 / 200) ** 0.5)
_COMPARED = 16  # frames at the beginning of a file that are compared to recognise its shape, at most
_SURE = 5.0  # standard errors by which the correlations of a shape exceed those of all others


class SpikeDatConfig(Config):
    """Frames one after the other: a bit for each pixel, the lowest bit of a byte first, without gaps between rows or frames."""

    path: SpecLocation = Field(description="the .dat file, or its URL")
    frame_shape: tuple[int, int] = Field(description="rows and columns of a frame, in px, such as [250, 400]")
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")

    @field_validator("frame_shape")
    @classmethod
    def _whole_bytes(cls, shape: tuple[int, int]) -> tuple[int, int]:
        if min(shape) < 1 or max(shape) > 65535 or shape[0] * shape[1] % 8:
            raise ValueError("rows and columns are from 1 to 65535, and a frame has a multiple of eight pixels")
        return shape


def layout_of(shape: tuple[int, int]) -> FrameLayout:
    """Return the layout of frames of (rows, columns); rows that are no whole bytes are repacked."""
    n_rows, n_columns = shape

    def to_rows(stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        pixels = np.unpackbits(stored, axis=1, bitorder="little").reshape(-1, n_rows, n_columns)
        return np.packbits(pixels, axis=2, bitorder="little")

    if n_columns % 8:
        return FrameLayout(shape, (n_rows * n_columns // 8,), "little", to_rows=to_rows)
    return FrameLayout(shape, (n_rows, n_columns // 8), "little")


def _open(config: SpikeDatConfig) -> PackedFileSource:
    """Open a capture; raises an `InputError` if it is missing, or its size is no whole number of frames."""
    size, frame_bytes = size_of(config.path), layout_of(config.frame_shape).stored_bytes
    n_frames, rest = divmod(size, frame_bytes)
    if n_frames and not rest:
        return _source(config, n_frames)
    shape, fitting = "x".join(map(str, config.frame_shape)), [f"[{h}, {w}]" for h, w in _fitting(size)]
    known = f"of the usual shapes, {' and '.join(fitting)} would fit" if fitting else "none of the usual shapes would fit"
    raise InputError(
        f"{config.path} has {size:,} bytes, and a frame of {shape} px takes {frame_bytes:,}: after {n_frames:,} frames, "
        f"{rest:,} bytes are left over; {known}: correct frame_shape, or copy the file again"
    )


def _source(config: SpikeDatConfig, n_frames: int) -> PackedFileSource:
    source = PackedFileSource([FrameFile(config.path, n_frames)], layout_of(config.frame_shape), config.frame_rate_hz)
    source.response = RESPONSE
    return source


def _arrived(config: SpikeDatConfig) -> Arrived:
    """Open the frames that are there of a file that is still being written."""
    path = config.path
    if isinstance(path, Url):
        raise InputError(f"{path} is a URL, which cannot be followed: follow a file, or a pipe")
    n_frames = size_of(path) // layout_of(config.frame_shape).stored_bytes if path.exists() else 0
    return Arrived(_source(config, n_frames) if n_frames else None)


def _fitting(size: int) -> Iterator[tuple[int, int]]:
    """Yield the usual shapes of which a file holds whole frames."""
    return (shape for shape in _SHAPES if size and size % layout_of(shape).stored_bytes == 0)


def _recognise(path: Location) -> Recognised | None:
    """Take a .dat file if neighbouring rows, and earlier and later frames, are most alike in one of the usual shapes."""
    if isinstance(path, Url) or path.suffix.lower() != ".dat" or not path.is_file():
        return None
    found = sorted(((_likeness(path, shape), shape) for shape in _fitting(size_of(path))), reverse=True)
    if not found or found[0][0] - max([0.0, *(score for score, _ in found[1:])]) < _SURE:
        return None
    shape = found[0][1]
    because = f"a .dat file of whole frames of {shape[0]}x{shape[1]} px, in which neighbouring rows and frames are alike"
    return Recognised({"path": as_written(path), "frame_shape": list(shape)}, because)


def _likeness(path: Location, shape: tuple[int, int]) -> float:
    """Return the smaller correlation, of neighbouring rows or of neighbouring frames, in standard errors."""
    layout = layout_of(shape)
    start = np.frombuffer(read_start(path, _COMPARED * layout.stored_bytes), np.uint8)
    frames = layout.unpacked(layout.rows(start.reshape(-1, *layout.stored_shape)))
    total = frames.sum(axis=0, dtype=np.float32)
    neighbours = (total[1:], total[:-1]), (frames[1:], frames[:-1])
    return min(correlation(first, second) * math.sqrt(first.size) for first, second in neighbours)


SPIKE_DAT = SourceContribution(
    name="spike-dat",
    summary="Binary frames of a spike camera in a .dat file, as SpikeCV and Spike-Zoo read it",
    config=SpikeDatConfig,
    build=lambda config, _: _open(config),
    check=lambda config: objections(_open, config),
    recognise=_recognise,
    arrived=_arrived,
    suffixes=(".dat",),
)
