"""The order of the pixels of binary frames in the bytes of a file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import BitOrder, packed_counts, reversed_bits
from photonpano.values import Counts

Pixels = TypeVar("Pixels", bound=np.generic)


class Arrangement(Protocol):
    """Moves blocks of stored images to their places in the image."""

    def __call__(self, images: NDArray[Pixels], /) -> NDArray[Pixels]:
        """Return (..., height, columns) of (..., rows, columns), where a column is a pixel or a byte of eight pixels.

        The pixels of a byte stay together. The argument must not be changed.
        """
        ...


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """The order of the pixels of a binary frame in its bytes.

    Pixels are reordered once in a sum of frames, and not in each frame.

    Attributes:
        frame_shape: (height, width) of the image.
        stored_shape: the shape of the bytes of a frame: its packed rows, unless there is a `to_rows`.
        bit_order: "big" if the first pixel is the highest bit of a byte, "little" if it is the lowest.
        arranged: turns stored images into images; None if their rows are those of the image.
        to_rows: turns (n, *stored_shape) into (n, rows, bytes of a row), packed along the width; None if frames are stored so.
    """

    frame_shape: tuple[int, int]
    stored_shape: tuple[int, ...]
    bit_order: BitOrder = "big"
    arranged: Arrangement | None = None
    to_rows: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] | None = None

    @property
    def stored_bytes(self) -> int:
        """Bytes of a frame in the file."""
        return math.prod(self.stored_shape)

    def rows(self, stored: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the packed rows (n, rows, bytes of a row) of stored frames (n, *stored_shape)."""
        return stored if self.to_rows is None else self.to_rows(stored)

    def add_counts(self, rows: NDArray[np.uint8], sums: Counts | None) -> Counts:
        """Add packed rows to their sums, which `image` turns into sums of the image."""
        return packed_counts(rows, 8 * rows.shape[-1], sums, self.bit_order)

    def unpacked(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Unpack packed rows to frames (n, H, W)."""
        return self.image(np.unpackbits(rows, axis=-1, bitorder=self.bit_order))

    def packed(self, rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return frames packed as by numpy, (n, H, ceil(W / 8)), which may share memory with `rows`."""
        packed = rows if self.bit_order == "big" else reversed_bits(rows)
        if self.arranged is not None:
            packed = self.arranged(packed)
        if beyond := -self.frame_shape[1] % 8:
            packed = packed.copy()
            packed[..., -1] &= 0xFF << beyond & 0xFF
        return packed

    def image(self, pixels: NDArray[Pixels]) -> NDArray[Pixels]:
        """Return (..., H, W) of pixels (..., rows, 8 times the bytes of a row)."""
        arranged = pixels if self.arranged is None else self.arranged(pixels)
        return np.ascontiguousarray(arranged[..., : self.frame_shape[1]])
