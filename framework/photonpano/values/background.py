"""What hides the background in parts of the frames of a capture."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photonpano.values.arrays import BoolArray, FloatArray
from photonpano.values.frames import FrameSpan

CELL_PX = 8  # side of the cells of a frame that are told from the background, in px


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Which cells of the frames show the background, which moves as the camera does; others show what moves by itself."""

    instants: FloatArray  # (S,) in order, in frames, S of 1 or more
    shown: BoolArray  # (S, h, w) bool, the cells, of 8 px a side, that show the background at each instant
    # (S, h, w) bool, these cells, and those that show least of something else at places whose background is never seen: every
    # place is shown by some
    filled: BoolArray
    frame_shape: tuple[int, int]  # (height, width) of a frame

    def cells(self, span: FrameSpan) -> BoolArray:
        """Return the cells that show the background at all instants in a span of frames, and at the ones next to it: (h, w)."""
        first, last = np.searchsorted(self.instants, [span.start, span.stop - 1])
        return np.asarray(self.shown[max(0, first - 1) : last + 1].all(axis=0))

    def pixels(self, span: FrameSpan) -> NDArray[np.uint8] | None:
        """Return the pixels that show the background in a span of frames, as 1, others as 0: (H, W); None if all do."""
        cells = self.cells(span)
        if cells.all():
            return None
        height, width = self.frame_shape
        return cells.view(np.uint8).repeat(CELL_PX, axis=0)[:height].repeat(CELL_PX, axis=1)[:, :width]

    def without(self, other: Background) -> Background:
        """Return what both show of the background."""
        nearest = np.abs(self.instants[:, None] - other.instants).argmin(axis=1)
        return replace(self, shown=self.shown & other.shown[nearest])

    def part(self, span: FrameSpan) -> Background:
        """Return that of some frames."""
        return replace(self, instants=self.instants - span.start)
