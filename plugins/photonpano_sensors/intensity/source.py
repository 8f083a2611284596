"""Base class of sources of grey levels: linear levels, and sums that are read in parts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError, StreamInfo
from photonpano.compiling import compiled
from photonpano.reading import Closing
from photonpano_sensors.intensity.configs import IntensityConfig
from photonpano_sensors.intensity.levels import Encoding, linear_levels

Levels: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

_PART_BYTES = 4 * 1024**2  # bytes of the frames that are read at once for a sum
_MOST_COUNT = 2**32 - 1
_BLOCK_PIXELS = 4096  # pixels summed at once: their sums stay in the L1 cache


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
        self._one_byte = encoding.bits <= 8

    @abstractmethod
    def _read(self, span: FrameSpan, levels: Levels) -> None:
        """Fill (n, H, W) with the levels of a span as they are in the file; raises an `InputError` if they cannot be read."""

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
