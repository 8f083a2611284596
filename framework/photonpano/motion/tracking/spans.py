"""Sums of short spans of frames in binned pixels: their shifts, and which part of a sum follows a shift."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano.contracts.protocols import Source
from photonpano.geometry import translation
from photonpano.locating import Follows, follows, shift_of_spectra
from photonpano.merging import binned_mean, binning_of
from photonpano.photometry import hann_window
from photonpano.values import FloatArray, FluxImage, FrameSpan

SHORTEST = {"binary": 4, "intensity": 1}  # frames of the shortest span: sums of fewer binary frames are mostly noise
PEAK_PX = 1.5  # standard deviation of the peak of the phase correlation, in binned pixels

Spectrum = NDArray[np.complexfloating]
_hann_window = cache(hann_window)
DARK = 0.2  # sums, and frames, with less than this share of the usual light show nothing


def span_image(source: Source, span: FrameSpan) -> FluxImage:
    """Return the mean counts of a span, binned: (h, w); where no pixel is valid, the mean of the others."""
    image = binned_mean(source, span)
    return np.nan_to_num(image, nan=float(np.nanmean(image)))


def stabilised(source: Source, mean_count: FluxImage, n_frames: float) -> FluxImage:
    """Return mean counts of binned pixels on the scale on which their noise is uniform."""
    frames = float(n_frames * binning_of(source) ** 2)
    return source.response.stabilised(source.response.flux(mean_count, frames), frames)


def noise_of_difference(source: Source, n_frames: float) -> float:
    """Return the variance of the difference of two `stabilised` images."""
    return 2 * float(source.response.stabilised_std(float(n_frames * binning_of(source) ** 2))) ** 2


def spectra_of(images: Sequence[FluxImage] | FluxImage, weight: FluxImage | None = None) -> Spectrum:
    """Return the spectra of images (S, h, w), of weighted mean 0, under a Hann window: (S, h, w // 2 + 1)."""
    window = _hann_window(images[0].shape)
    if weight is not None:
        window = window * weight
    share = window / max(float(window.sum()), 1e-12)
    return np.array([fft.rfft2(window * (image - float((share * image).sum()))) for image in images])


def shifts_between(moving: Spectrum, fixed: Spectrum, shape: tuple[int, ...]) -> list[FloatArray | None]:
    """Return the shift (x, y) of each pair of spectra, in binned pixels; None without texture."""
    pairs = zip(moving, fixed, strict=True)
    return [shift_of_spectra(before, after, shape, PEAK_PX, gaussian_peak=False) for before, after in pairs]


def shifted(image: FluxImage, shift: FloatArray) -> FluxImage:
    """Return an image seen along a shift: `shifted(p) = image(p + shift)`; NaN outside."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(image, translation(*shift)[:2], image.shape[::-1], flags=flags, borderValue=np.nan), np.float32
    )


def following(moving: FluxImage, fixed: FluxImage, noise: float) -> Follows:
    """Find the part of an image that shows the same as another one, seen along a motion.

    Both are (h, w) on the scale on which noise is uniform, NaN where nothing is seen; `noise` is the variance of their
    difference.
    """
    seen = np.isfinite(moving) & np.isfinite(fixed)
    return follows(np.nan_to_num(moving), np.nan_to_num(fixed), np.where(seen, np.float32(noise), np.float32(np.inf)))
