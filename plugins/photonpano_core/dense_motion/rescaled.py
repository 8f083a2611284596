"""Rescale sums of frames."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano.merging import PhotonSum


def rescaled(photons: PhotonSum, scale: float) -> PhotonSum:
    """Return a sum on the grid of another scale; each pixel averages counts and weights alike, so that flux stays the same.

    Convention:
        The pixel centre p goes to `(p + 0.5) * scale - 0.5`.
    """
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    counts, weight = (
        np.asarray(cv2.resize(each, None, fx=scale, fy=scale, interpolation=how), np.float32)
        for each in (photons.counts, photons.weight)
    )
    return PhotonSum(counts, weight)
