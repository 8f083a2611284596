"""Find hot and dead pixels, in dark frames or in the capture itself, and mask them."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from photonpano.contributions import SpecPath
from photonpano.corrections.dark import DARK_FILE, read_dark
from photonpano.corrections.pixels import Correction

if TYPE_CHECKING:
    from photonpano.corrections.dark import DarkFrames
    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.protocols import Source
    from photonpano.values import BoolArray, FluxImage

THRESHOLD = 10.0
"""Default threshold, in robust standard deviations: it finds a few percent of the pixels of real sensors."""
_SPANS, _SPAN_FRAMES = 16, 256
"""16 spans of 256 frames are summed all over the capture, which blurs the scene."""
_REACH = 2
"""Neighbourhood radius, px."""
_ONE_IN = 6
"""A pixel is hot if it is brighter than the top 1/6 of its neighbours by the threshold. A straight edge or a line of the scene
makes at least 1/6 of them bright, at the border of the frame as well."""
_TO_STD = 1.4826
"""Standard deviation of a normal distribution divided by its median absolute deviation."""


class HotPixels(Correction):
    """Finds hot pixels and masks them; the motion fills them."""

    name: ClassVar[str] = "hot-pixels"
    dark: SpecPath | None = Field(
        None,
        description=f"dark counts per frame: {DARK_FILE}; by default, pixels of the capture that are much brighter or darker "
        "than their neighbours are masked, for which the camera has to move",
    )
    threshold: float = Field(
        THRESHOLD,
        gt=0,
        le=1000,
        description="smallest deviation of a hot pixel, in robust standard deviations of the other pixels",
    )

    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """Mask the pixels that stand out; see `Correction`."""
        if self.dark is not None:
            dark = read_dark(self.dark)
            pixels.require(dark.rates.shape, self.dark)
            bad, limit = hot_in_the_dark(dark, self.threshold, pixels.valid)
            how = f"have more than {limit:.2g} dark counts a frame in {self.dark.name}"
        elif decide is not None:
            bad, n_frames = _standing_out(pixels, source, self.threshold)
            how = f"stand out from their neighbours in {n_frames} frames sampled all over the capture"
        else:
            return pixels
        if decide is not None:
            n_bad, n_pixels = int((bad & pixels.valid).sum()), int(pixels.valid.sum())
            share = n_bad / max(n_pixels, 1)
            decide("hot_pixels", n_bad, f"{share:.2%} of {n_pixels} pixels {how}, by threshold = {self.threshold:g}")
        return pixels.without(bad)


def hot_in_the_dark(dark: DarkFrames, threshold: float, valid: BoolArray) -> tuple[BoolArray, float]:
    """Return the pixels that have far more dark counts than most.

    Args:
        dark: the dark counts.
        threshold: standard deviations above the median from which a pixel is hot. The standard deviation comes from the median
            absolute deviation, and is at least that of photon noise.
        valid: (H, W) the pixels that count for the median.

    Returns:
        (H, W) mask of hot pixels, and the rate above which pixels are hot.
    """
    rates = dark.rates[valid]
    if not rates.size:
        return np.zeros(valid.shape, np.bool_), np.inf
    median = float(np.median(rates))
    std = _TO_STD * float(np.median(np.abs(rates - median)))
    if dark.n_frames is not None:
        # One count by chance must not make a pixel hot.
        std = max(std, float(np.sqrt(max(median, 1 / dark.n_frames) / dark.n_frames)))
    limit = median + threshold * std
    return dark.rates > limit, limit


def _standing_out(pixels: Pixels, source: Source, threshold: float) -> tuple[BoolArray, int]:
    """Return the pixels of a capture that are brighter or darker than their neighbours, and the number of frames compared."""
    spans = source.info.spread(_SPANS, _SPAN_FRAMES)
    seen = sum(map(len, spans))
    counts = np.sum([source.counts(span) for span in spans], axis=0)
    response, frames = source.response, float(seen)
    image = response.stabilised(response.flux(np.asarray(counts / seen, np.float32), frames), frames)
    usable = pixels.valid & ~pixels.interpolated
    image = np.where(usable, image.ravel()[pixels.index], np.float32(np.nan))
    outside = np.fmax(image - _ranked(image, _ONE_IN), -image - _ranked(-image, _ONE_IN))
    differences = np.abs(image - _ranked(image, 2))
    typical = float(np.median(known)) if (known := differences[np.isfinite(differences)]).size else 0.0
    std = max(_TO_STD * typical, float(np.max(response.stabilised_std(frames))))
    return outside > threshold * std, seen


def _ranked(image: FluxImage, one_in: int) -> FluxImage:
    """Return, for each pixel, the value that `1 / one_in` of its neighbours reach; NaN where fewer than 6 are known."""
    side = 2 * _REACH + 1
    padded = np.pad(image, _REACH, constant_values=np.nan)
    windows = sliding_window_view(padded, (side, side)).reshape(*image.shape, side * side)
    around = np.sort(np.delete(windows, side * side // 2, axis=-1), axis=-1)  # NaN comes last
    known = np.isfinite(around).sum(axis=-1, keepdims=True)
    place = np.clip(known - known // one_in, 0, around.shape[-1] - 1)
    found = np.take_along_axis(around, place, axis=-1)[..., 0]
    return np.where(known[..., 0] >= _ONE_IN, found, np.float32(np.nan))
