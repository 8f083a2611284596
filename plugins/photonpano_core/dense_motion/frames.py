"""Sums of frames: corrected and weighted, rescaled, and the noise of their counts."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano import FrameSpan, Response, Source, capture_of
from photonpano.merging import PhotonSum
from photonpano_core.dense_motion.field import Image

_MANY = 1e4  # frames for which the variance of a count is derived; it is then divided by them
_SHARE = np.float32(0.01)  # relative step of the numerical derivative


class WeightedFrames:
    """Returns the sum of the frames of a span: (H, W) float32, corrected, and multiplied by the weight of each pixel."""

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


def rescaled(photons: PhotonSum, scale: float) -> PhotonSum:
    """Return a sum on the grid of another scale: p goes to `(p + 0.5) * scale - 0.5`. Flux stays the same."""
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    counts, weight = (
        np.asarray(cv2.resize(each, None, fx=scale, fy=scale, interpolation=how), np.float32)
        for each in (photons.counts, photons.weight)
    )
    return PhotonSum(counts, weight)


def count_variance(mean: Image, response: Response) -> Image:
    """Return the variance of the count of one frame of this mean, from the slope of the scale on which it is uniform."""
    low, high = mean * (1 - _SHARE), mean * (1 + _SHARE) + np.float32(1e-4)
    low_value, high_value = (response.stabilised(response.flux(each, _MANY), _MANY) for each in (low, high))
    per_unit = (high - low) / np.maximum(high_value - low_value, np.float32(1e-9))
    return np.asarray(_MANY * (response.stabilised_std(_MANY) * per_unit) ** 2, np.float32)
