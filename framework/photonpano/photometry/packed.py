"""Sums of bit-packed binary frames."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.values import Counts

# Whether the first of eight pixels is the highest bit of their byte or the lowest, as in `numpy.packbits`.
BitOrder: TypeAlias = Literal["big", "little"]

MAX_FRAMES = 255  # most frames whose sum fits into a byte
_BLOCK_BYTES = 1024**2  # bytes of frames that are summed at a time: about the cache of a core


def packed_counts(
    packed: NDArray[np.uint8],
    width: int,
    counts: Counts | None = None,
    bit_order: BitOrder = "big",
    *,
    small: bool = False,
) -> Counts:
    """Sum bit-packed frames, pixel by pixel, in little memory beyond the result.

    Args:
        packed: (n, H, ceil(width / 8)) uint8, packed along the width as `numpy.packbits` does. A memory-mapped array is read
            in blocks.
        width: W, columns of a frame; the bits beyond it are ignored.
        counts: (H, W) uint32 to add the sum to; None for zeros.
        bit_order: which bit of a byte is its first pixel.
        small: whether the sum of up to 255 frames is given as uint8, which takes less time and memory.

    Returns:
        (H, W) uint32 or uint8: `counts` if it was given.

    Raises:
        ValueError: an array has another type or shape.
    """
    if packed.dtype != np.uint8 or packed.ndim != 3 or packed.shape[2] != -(-width // 8):
        raise ValueError(
            f"packed frames of width {width} must be uint8 (n, H, {-(-width // 8)}), got {packed.dtype} {packed.shape}"
        )
    from photonpano.photometry.bits import sum_bits

    n_frames, height, row_bytes = packed.shape
    if counts is not None and (counts.dtype != np.uint32 or counts.shape != (height, width) or not counts.flags.c_contiguous):
        raise ValueError(f"counts must be contiguous uint32 {(height, width)}, got {counts.dtype} {counts.shape}")
    step = min(MAX_FRAMES, max(8, _BLOCK_BYTES // max(1, height * row_bytes)))
    if small and 0 < n_frames <= MAX_FRAMES:
        step = MAX_FRAMES
    elif counts is None:
        counts = np.zeros((height, width), np.uint32)
    for start in range(0, n_frames, step):
        block = np.ascontiguousarray(packed[start : start + step])
        lit = np.empty((height, 8 * row_bytes), np.uint8)
        sum_bits(block.reshape(-1), len(block), bit_order == "little", lit.reshape(-1))
        if counts is None:
            return np.ascontiguousarray(lit[:, :width])
        counts += lit[:, :width]
    assert counts is not None
    return counts


def reversed_bits(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Convert packed pixels from one bit order to the other: an array of the same shape."""
    from photonpano.photometry.bits import reverse_bits

    turned = np.empty(packed.shape, np.uint8)
    reverse_bits(np.ascontiguousarray(packed).reshape(-1), turned.reshape(-1))
    return turned


def packed_along_width(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Repack frames from along the height to along the width: (n, H / 8, W) becomes (n, H, ceil(W / 8))."""
    from photonpano.photometry.bits import transpose_bits

    n_frames, rows, width = packed.shape
    turned = np.empty((n_frames, 8 * rows, -(-width // 8)), np.uint8)
    transpose_bits(np.ascontiguousarray(packed).reshape(-1, width), turned.reshape(n_frames * 8 * rows, -1))
    return turned
