"""Compiled loops over grey levels: sum them, and unpack levels of 12 bits."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled

Levels: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]

_BLOCK = 4096
"""Pixels summed at once: their sums stay in the L1 cache."""


@compiled
def add_levels(frames: Levels, total: NDArray[np.uint32]) -> None:
    """Add frames, (n, N) levels, to the sums of their pixels, (N,)."""
    for start in range(0, len(total), _BLOCK):
        block = total[start : start + _BLOCK]
        for index in range(len(frames)):
            levels = frames[index, start : start + _BLOCK]
            for pixel in range(len(block)):
                block[pixel] += np.uint32(levels[pixel])


@compiled
def add_linear(frames: Levels, table: NDArray[np.uint16], total: NDArray[np.uint32]) -> None:
    """Add the values of a table for the levels of frames."""
    for start in range(0, len(total), _BLOCK):
        block = total[start : start + _BLOCK]
        for index in range(len(frames)):
            levels = frames[index, start : start + _BLOCK]
            for pixel in range(len(block)):
                block[pixel] += np.uint32(table[levels[pixel]])


@compiled
def unpack_12_bits(packed: NDArray[np.uint8], levels: NDArray[np.uint16]) -> None:
    """Unpack two levels from every three bytes, the higher bits first: (3 n,) to (2 n,)."""
    for pair in range(len(levels) // 2):
        first, middle, last = packed[3 * pair], packed[3 * pair + 1], packed[3 * pair + 2]
        levels[2 * pair] = np.uint16(first) << 4 | np.uint16(middle) >> 4
        levels[2 * pair + 1] = (np.uint16(middle) & 15) << 8 | np.uint16(last)
