"""Sums of frames, corrected and weighted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, Source, capture_of

Image = NDArray[np.float32]


class WeightedFrames:
    """Returns the sum of the frames of a span: (H, W) float32, corrected, and multiplied by what each pixel is worth.

    Attributes:
        worth: (H, W) float32, what a frame of each pixel is worth, from 0, for a masked one, to 1; (0, 0) if it is 1 for all.
    """

    def __init__(self, source: Source) -> None:
        self._capture = capture = capture_of(source)
        if capture.weight is not None:
            self.worth: Image = np.where(source.valid, capture.weight, np.float32(0))
        else:
            self.worth = np.zeros((0, 0), np.float32) if source.valid.all() else source.valid.astype(np.float32)

    def __call__(self, span: FrameSpan) -> Image:
        """Sum the frames of a span."""
        lit = np.asarray(self._capture.corrected_counts(span), np.float32)
        return lit * self.worth if self.worth.size else lit
