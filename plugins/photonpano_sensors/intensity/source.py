"""Base class of sources of grey levels, which are made linear in flux, so that frames can be summed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError, StreamInfo
from photonpano.compiling import compiled
from photonpano.photometry import IntensityResponse, srgb_to_linear
from photonpano.reading import Closing, reading
from photonpano_sensors.intensity.contributions import IntensityConfig, ResponseConfig

Levels: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

_PART_BYTES = 4 * 1024**2  # bytes of the frames that are read at once for a sum
_LOOKED_AT = 3  # frames by which binary ones are told from grey ones
_BITS = [0, 255], [0, 65535], [16, 235]  # the levels of these
_MOST_COUNT = 2**32 - 1
_BLOCK_PIXELS = 4096  # pixels summed at once: their sums stay in the L1 cache
_HIGHEST = 2**16 - 1  # the highest linear level


class IntensitySource(Closing, ABC):
    """Grey levels that are linear in flux: a `photonpano.Source`.

    A saturated pixel counts with the saturation level, so its flux is a lower bound.
    """

    def __init__(
        self, config: IntensityConfig, shape: tuple[int, int, int], frame_rate_hz: float | None, encoding: Encoding
    ) -> None:
        """Take (frames, height, width), the frame rate unless the spec has one, and the encoding of the levels of the file."""
        linear = linear_levels(config.response, encoding)
        self.info = StreamInfo(*shape, config.frame_rate_hz or frame_rate_hz, "intensity", linear.bits)
        self.response = linear.response
        self.valid: NDArray[np.bool_] = np.ones(self.info.frame_shape, np.bool_)
        self.valid.flags.writeable = False
        self._table = linear.table
        self._encoding, self._one_byte = encoding, encoding.bits <= 8

    @abstractmethod
    def _read(self, span: FrameSpan, levels: Levels) -> None:
        """Fill (n, H, W) with the levels of a span as they are in the file; raises an `InputError` if they cannot be read."""

    def refuse_binary(self, path: Path, pictures: str) -> None:
        """Refuse frames of zeros and ones with an `InputError`; `pictures` is Python code that reads all of them.

        From one frame to the next, levels of black and white jump by as much as their mean allows. A codec with loss halves
        that at most, unless little is left of the frames; grey levels reach a hundredth.
        """
        try:
            levels = [self._levels_of(each) for each in self.info.spread(_LOOKED_AT, min(2, self.info.n_frames))]
        except InputError:  # a damaged frame is refused when it is read
            return
        values = np.unique(levels).tolist()
        black, white = self._encoding.black, self._encoding.white
        first, last = (np.clip([each[index] for each in levels], black, white) for index in (0, -1))
        mean = (first + last) / 2
        lossy = ((first - last) ** 2).sum() / 4 > ((mean - black) * (white - mean)).sum() / 2
        if values in _BITS or lossy:
            self.close()
            if values not in _BITS:
                raise InputError(
                    f"{path} seems to hold binary frames that a codec changed: levels jump from dark to bright from one frame "
                    "to the next, as photons do. Which pixels were lit is lost: record without compression, or with ffv1"
                )
            saved = f'numpy.save("cube.npy", numpy.packbits(numpy.array({pictures}) > 99, axis=-1))'
            only = f"binary frames, of {values[0]} and {values[1]} only"
            raise InputError(f"{path} holds {only}, which are no grey levels; in Python, save them for packed-npy: {saved}")

    def frames(self, span: FrameSpan) -> Levels:
        """Return the frames of a span, in linear levels: (n, H, W)."""
        self.info.require(span)
        levels = self._levels_of(span)
        return levels if self._table is None else self._table[levels]

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32; raises an `InputError` if the sum might not fit."""
        self.info.require(span)
        most = _MOST_COUNT // (2**self.info.bit_depth - 1)
        if len(span) > most:
            raise InputError(f"{span} are too many to be summed at {self.info.bit_depth} bits; use groups of {most} at most")
        counts = np.zeros(self.info.frame_shape, np.uint32)
        step = max(1, _PART_BYTES // (counts.size * (1 if self._one_byte else 2)))
        for block in span.blocks(step):
            levels = self._levels_of(block)
            flat = levels.reshape(len(levels), -1)
            if self._table is None:
                _add_levels(flat, counts.reshape(-1))
            else:
                _add_linear(flat, self._table, counts.reshape(-1))
        return counts

    def _levels_of(self, span: FrameSpan) -> Levels:
        shape = len(span), *self.info.frame_shape
        levels: Levels = np.empty(shape, np.uint8) if self._one_byte else np.empty(shape, np.uint16)
        self._read(span, levels)
        return levels


@compiled
def _add_levels(frames: Levels, total: NDArray[np.uint32]) -> None:
    """Add frames, (n, N) levels, to the sums of their pixels, (N,)."""
    for start in range(0, len(total), _BLOCK_PIXELS):
        block = total[start : start + _BLOCK_PIXELS]
        for index in range(len(frames)):
            levels = frames[index, start : start + _BLOCK_PIXELS]
            for pixel in range(len(block)):
                block[pixel] += np.uint32(levels[pixel])


@compiled
def _add_linear(frames: Levels, table: NDArray[np.uint16], total: NDArray[np.uint32]) -> None:
    """Add the values of a table for the levels of frames."""
    for start in range(0, len(total), _BLOCK_PIXELS):
        block = total[start : start + _BLOCK_PIXELS]
        for index in range(len(frames)):
            levels = frames[index, start : start + _BLOCK_PIXELS]
            for pixel in range(len(block)):
                block[pixel] += np.uint32(table[levels[pixel]])


@dataclass(frozen=True, slots=True)
class Encoding:
    """The encoding of the levels of a file."""

    bits: int  # bits of a level
    black: float  # the level without light
    white: float  # the level at which a pixel saturates

    @classmethod
    def full(cls, bits: int) -> Encoding:
        """Return the encoding that uses all levels."""
        return cls(bits, 0.0, 2.0**bits - 1)


@dataclass(frozen=True, slots=True, eq=False)
class LinearLevels:
    """The conversion of levels of a file to linear levels, and their response."""

    bits: int  # bits of a linear level
    # (2^b,), the linear level of each level of a file of b bits; None if these are linear already
    table: NDArray[np.uint16] | None
    response: IntensityResponse  # how flux becomes linear levels


def linear_levels(config: ResponseConfig, encoding: Encoding) -> LinearLevels:
    """Return the conversion of the levels of a file to linear levels.

    The curve is continued below black, point-symmetrically, so that noise in the dark is not clipped. Quantisation noise, that
    of the levels in the middle of the range, is added to the read noise. Raises an `InputError` if the levels, or a file, do
    not suit.
    """
    black = encoding.black if config.black_level is None else config.black_level
    white = encoding.white if config.white_level is None else config.white_level
    top = 2**encoding.bits - 1
    if not black < white <= top:
        raise InputError(
            f"black_level {black:g} and white_level {white:g} do not suit levels of {encoding.bits} bits: "
            f"black must be below white, and white at most {top}"
        )
    photons_per_level = config.saturation_photons / (white - black)
    read_noise = float(np.hypot(config.read_noise, photons_per_level / np.sqrt(12)))
    if config.curve == "linear" and config.curve_file is None:
        return LinearLevels(encoding.bits, None, IntensityResponse(photons_per_level, black, white, read_noise))
    encoded = (np.arange(top + 1) - black) / (white - black)
    light: NDArray[np.float64] = np.sign(encoded)
    if config.curve_file is None:
        size = np.abs(encoded)
        light = light * (srgb_to_linear(size) if isinstance(config.curve, str) else size**config.curve)
    else:
        light = _measured(config.curve_file, len(encoded))
        at_black, at_white = np.interp([black, white], np.arange(top + 1), light)
        if not at_black < at_white:
            raise InputError(f"{config.curve_file}: the curve does not rise from the black level to the white level")
        light = (light - at_black) / (at_white - at_black)
    lowest = min(float(light[0]), 0.0)
    scale = _HIGHEST / (max(float(light[-1]), 1.0) - lowest)
    table = np.rint((light - lowest) * scale).astype(np.uint16)
    # Integers, so that the flux of a black frame is exactly 0.
    zero, one = round(-lowest * scale), round((1 - lowest) * scale)
    return LinearLevels(16, table, IntensityResponse(config.saturation_photons / (one - zero), zero, one, read_noise))


def _measured(path: Path, n_levels: int) -> NDArray[np.float64]:
    with reading(path, "is not a text file of numbers, one for each level"):
        light = np.array([float(word) for word in path.read_text(encoding="utf-8").split()])
    if len(light) != n_levels:
        raise InputError(f"{path} holds {len(light)} numbers; the levels of the capture are {n_levels}")
    if not (np.all(np.isfinite(light)) and np.all(np.diff(light) >= 0)):
        raise InputError(f"{path}: the numbers must be finite, and none smaller than the one before")
    return light
