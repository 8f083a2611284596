"""Reorder bits within bytes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled


@compiled
def reverse_bits(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> None:
    """Write bytes (n,) to a target (n,), the bits of each in reverse (Hacker's Delight, section 7-1)."""
    for j in range(len(source)):
        x = np.uint32(source[j])
        x = ((x >> np.uint32(1)) & np.uint32(0x55)) | ((x & np.uint32(0x55)) << np.uint32(1))
        x = ((x >> np.uint32(2)) & np.uint32(0x33)) | ((x & np.uint32(0x33)) << np.uint32(2))
        target[j] = (x >> np.uint32(4)) | (x << np.uint32(4))


@compiled
def transpose_bits(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> None:
    """Pack along the rows of an image what is packed along its columns (Hacker's Delight, section 7-3).

    Args:
        source: (rows, columns); the bits of a byte are eight pixels of a column, the first the highest.
        target: (8 rows, ceil(columns / 8)), the output.
    """
    rows, columns = source.shape
    for row in range(rows):
        for byte in range(target.shape[1]):
            x = np.uint64(0)
            for k in range(min(8, columns - 8 * byte)):
                x |= np.uint64(source[row, 8 * byte + k]) << np.uint64(8 * (7 - k))
            t = (x ^ (x >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
            x ^= t ^ (t << np.uint64(7))
            t = (x ^ (x >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
            x ^= t ^ (t << np.uint64(14))
            t = (x ^ (x >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
            x ^= t ^ (t << np.uint64(28))
            for k in range(8):
                target[8 * row + k, byte] = np.uint8((x >> np.uint64(8 * (7 - k))) & np.uint64(255))
