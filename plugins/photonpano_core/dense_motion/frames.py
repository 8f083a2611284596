"""Sums of frames, corrected and weighted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, LinearlyCorrectedSource, Source, WeightedSource

Image = NDArray[np.float32]


class WeightedFrames:
    """Returns the sum of the frames of a span: (H, W) float32, corrected, and multiplied by what each pixel is worth.

    Attributes:
        worth: (H, W) float32, what a frame of each pixel is worth, from 0, for a masked one, to 1; (0, 0) if it is 1 for all.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._corrected = source.corrected if isinstance(source, LinearlyCorrectedSource) else None
        if isinstance(source, WeightedSource):
            self.worth: Image = np.where(source.valid, source.weights(), np.float32(0))
        else:
            self.worth = np.zeros((0, 0), np.float32) if source.valid.all() else source.valid.astype(np.float32)

    def __call__(self, span: FrameSpan) -> Image:
        """Sum the frames of a span."""
        summed = self._source.counts(span)
        counts = self._corrected(summed, len(span)) if self._corrected else summed
        lit = np.asarray(counts, np.float32)
        return lit * self.worth if self.worth.size else lit
