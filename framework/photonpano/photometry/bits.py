"""The order of bits in bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.compiling import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray


@compiled
def reverse_bits(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> None:
    """Write bytes (n,) to a target (n,), the bits of each in reverse (Hacker's Delight, section 7-1)."""
    for j in range(len(source)):
        x = np.uint32(source[j])
        x = ((x >> np.uint32(1)) & np.uint32(0x55)) | ((x & np.uint32(0x55)) << np.uint32(1))
        x = ((x >> np.uint32(2)) & np.uint32(0x33)) | ((x & np.uint32(0x33)) << np.uint32(2))
        target[j] = (x >> np.uint32(4)) | (x << np.uint32(4))
