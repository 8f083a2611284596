"""Rearrange the pixels of frames, and correct sums of them linearly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, Counts, FluxImage, FrameSpan

Index: TypeAlias = NDArray[np.intp]
MISSING = -1  # the index of a pixel that the sensor does not have


def numbered(shape: tuple[int, ...]) -> Index:
    """Number the pixels of a frame along its rows, from 0: (H, W) intp."""
    return np.arange(np.prod(shape), dtype=np.intp).reshape(shape)


@dataclass(frozen=True, slots=True, eq=False)
class MaskedSpan:
    """Pixels that must not be used in some frames, such as those that a hand hides for a second."""

    span: FrameSpan  # frames of the source
    valid: BoolArray  # (H, W) mask, False for these pixels


class Gather:
    """Gathers the pixels of an index from frames; as a slice if the index is a contiguous part of the frame."""

    def __init__(self, index: Index, frame_shape: tuple[int, int]) -> None:
        """Take the (H, W) numbers of the pixels in frames of (h, w), or `MISSING`."""
        self.index = index
        self._missing = index == MISSING
        self._places = np.where(self._missing, 0, index)
        top, left = divmod(int(index[0, 0]), frame_shape[1])
        part = slice(top, top + index.shape[0]), slice(left, left + index.shape[1])
        self._slices = part if np.array_equal(numbered(frame_shape)[part], index) else None

    def __call__(self, frames: Any) -> Any:
        """Gather the pixels of (..., h, w) frames: (..., H, W), 0 where the sensor has none."""
        if self._slices is not None:
            return np.ascontiguousarray(frames[..., self._slices[0], self._slices[1]])
        *n, _, _ = frames.shape
        gathered = np.take(frames.reshape(*n, -1), self._places, axis=-1)
        gathered[..., self._missing] = 0
        return gathered


@dataclass(frozen=True, slots=True, eq=False)
class LinearCorrection:
    """Corrects sums of frames, `slope * counts + n * offset` for n frames, and fills pixels from their neighbours."""

    slope: FluxImage  # (H, W) float32
    offset: FluxImage  # (H, W) float32, added for each frame
    # (P,) numbers of the pixels that are replaced, (P, N) those of the neighbours of each, and (P, N) float32, the weights of
    # these, which sum to 1; None if no pixel is replaced
    filling: tuple[Index, Index, FluxImage] | None = None

    def __call__(self, counts: Counts | FluxImage, n_frames: int) -> FluxImage:
        """Correct the sum of a number of frames: (H, W) float32."""
        summed = np.asarray(counts * self.slope + np.float32(n_frames) * self.offset, np.float32)
        if self.filling is not None:
            filled, neighbours, shares = self.filling
            flat = summed.reshape(-1)
            flat[filled] = (flat[neighbours] * shares).sum(axis=1)
        return summed
