"""Sums of bit-packed binary frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.values import Counts

_BLOCK_BYTES = 1024**2
"""Unpacked bytes held at a time: about what a core's cache holds."""
_MAX_FRAMES = 255
"""More frames than this could overflow the 8-bit sum of a block."""


def packed_counts(packed: NDArray[np.uint8], width: int) -> Counts:
    """Sum bit-packed frames, pixel by pixel, in a few megabytes beyond the result.

    Args:
        packed: (n, H, ceil(width / 8)) uint8, packed along the width as `numpy.packbits` does: the first pixel is the highest
            bit. A memory-mapped array is read in blocks.
        width: W, columns of a frame; the bits beyond it are ignored.

    Returns:
        (H, W) uint32; zeros for no frames.

    Raises:
        ValueError: the array is not of that type or shape.
    """
    if packed.dtype != np.uint8 or packed.ndim != 3 or packed.shape[2] != -(-width // 8):
        raise ValueError(
            f"packed frames of width {width} are uint8 (n, H, {-(-width // 8)}), got {packed.dtype} {packed.shape}"
        )
    n_frames, height, _ = packed.shape
    counts = np.zeros((height, width), dtype=np.uint32)
    step = min(_MAX_FRAMES, max(1, _BLOCK_BYTES // max(1, height * width)))
    for start in range(0, n_frames, step):
        frames = np.unpackbits(packed[start : start + step], axis=-1, count=width)
        counts += np.add.reduce(frames, axis=0, dtype=np.uint8)
    return counts
