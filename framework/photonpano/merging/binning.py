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
    capture = capture_of(source)
    counts = np.asarray(capture.corrected(capture.chunk(span), len(span)), np.float32)[:height, :width]
    weights = weights_of(capture)
    if weights is None:
        return np.asarray(cv2.resize(counts, size, interpolation=cv2.INTER_AREA) / np.float32(len(span)), np.float32)
    valid = weights[:height, :width]
    share, summed = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (valid, counts * valid))
    mean = np.full(share.shape, np.nan, dtype=np.float32)
    np.divide(summed, share * len(span), out=mean, where=share > 0)
    return mean
