"""Sums of frames in large pixels, in which a short span shows a motion beyond its noise."""

from __future__ import annotations

import cv2
import numpy as np

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.merging.accumulate import weights_of
from photonpano.values import FluxImage, FrameSpan

# Pixels are binned until the shorter side has about 64 of them, which lowers the noise and keeps shifts measurable.
_SIDE_PX = 64


def binning_of(source: Source) -> int:
    """Return the side of a binned pixel, in px."""
    return max(1, min(source.info.frame_shape) // _SIDE_PX)


def binned_mean(source: Source, span: FrameSpan) -> FluxImage:
    """Return the mean count per frame of a span in binned pixels; NaN where no pixel is valid."""
    binning = binning_of(source)
    height, width = (side // binning * binning for side in source.info.frame_shape)
    size = (width // binning, height // binning)
    weights = weights_of(source)
    valid = np.ones((height, width), np.float32) if weights is None else weights[:height, :width]
    lit = capture_of(source).corrected_counts(span)[:height, :width] * valid
    share, summed = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (valid, lit.astype(np.float32)))
    mean = np.full(share.shape, np.nan, dtype=np.float32)
    np.divide(summed, share * len(span), out=mean, where=share > 0)
    return mean
