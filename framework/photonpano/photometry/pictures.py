"""Tone curves and tone mapping: flux to pictures of 8 bits, and back."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Factors of red, green and blue in a picture: all 1, those that make the mean grey, or given ones.
WhiteBalance: TypeAlias = Literal["none", "grey-world"] | tuple[float, float, float]
# Range of OpenCV's operators, in powers of ten: what is darker than 1e-4 of the brightest pixel is black in them.
_OPENCV_DECADES = 4.0
_FLOOR_QUANTILE = 0.01  # quantile of the positive flux that is the darkest in a picture; below, there is mostly noise
_EVEN = 1.01  # an image that is not brighter than its darkest pixels by this factor has no range to compress
_WHITE_QUANTILE = 0.995  # quantile that is white after an operator that has a brightness of its own
_ERRORS = 2  # the log level of OpenCV at which it writes errors only
_BASE_STOPS = 4.5  # range to which `local` compresses the light without its details, in powers of two
_BASE_SHARE = 1 / 60  # radius of the details that `local` keeps, as a share of the longer side
_BASE_EDGE = 1.0  # steps of more than this many stops count as edges of the light, not as details


def srgb_to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1): encoded values in [0, 1] to linear intensities in [0, 1]."""
    encoded = np.asarray(encoded, dtype=np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Apply the sRGB curve: linear intensities, clipped to [0, 1], to encoded values in [0, 1]. NaN stays NaN."""
    linear = np.clip(np.asarray(linear, dtype=np.float32), 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def balanced(flux: NDArray[np.float32], white_balance: WhiteBalance) -> NDArray[np.float32]:
    """Multiply the colours of an image by the factors of a white balance; a grey image stays as it is.

    Args:
        flux: (H, W), or (H, W, 3) of red, green and blue; NaN where unknown.
        white_balance: "grey-world" makes the means of the colours equal, and keeps that of green.
    """
    if flux.ndim == 2 or white_balance == "none":
        return flux
    if white_balance != "grey-world":
        return np.asarray(flux * np.array(white_balance, np.float32), np.float32)
    return np.asarray(flux * grey_world(flux), np.float32)


def grey_world(flux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the factors of red, green and blue that make the means of an image equal, and keep that of green: (3,)."""
    means = np.nanmean(flux, axis=(0, 1)) if np.isfinite(flux).any() else np.ones(3, np.float32)
    return np.asarray(means[1] / np.maximum(means, 1e-6), np.float32)


def tone_mapped(flux: NDArray[np.float32], white: float, *, srgb: bool = True) -> NDArray[np.uint8]:
    """Return a picture of 8 bits: `white` photons per pixel per frame become 255, unknown pixels are black.

    Args:
        flux: photons per pixel per frame, NaN where unknown; of any shape.
        white: flux that becomes white, as does any higher one.
        srgb: whether levels follow the sRGB curve, for screens, or are proportional to the flux.
    """
    level = linear_to_srgb(flux / white) if srgb else np.clip(flux / white, 0, 1)
    return np.asarray(np.nan_to_num(level) * 255 + 0.5).astype(np.uint8)


# How flux becomes a picture: the sRGB curve, three operators of OpenCV, and one that keeps local contrast.
Tone = Literal["srgb", "reinhard", "drago", "mantiuk", "local"]


def picture_of(flux: NDArray[np.float32], white: float, tone: Tone = "srgb", stops: float = 0.0) -> NDArray[np.uint8]:
    """Return a picture of 8 bits in sRGB; unknown pixels are black.

    Args:
        flux: (H, W) or (H, W, 3), photons per pixel per frame, NaN where unknown.
        white: flux that becomes white with the tone "srgb"; the others find their own.
        tone: "srgb" shows flux up to `white` as it is. The others compress the range: "reinhard" (Reinhard and Devlin 2005),
            "drago" (Drago et al. 2003) and "mantiuk" (Mantiuk et al. 2006) with OpenCV; "local" compresses the light and keeps
            the details, as Durand and Dorsey 2002.
        stops: exposure: how much brighter the picture is, in powers of two.
    """
    if tone == "srgb":
        return tone_mapped(flux, white / 2**stops)
    known = np.isfinite(flux)
    positive = flux[known & (flux > 0)]
    if not positive.size:
        return np.zeros(flux.shape, np.uint8)
    floor = np.quantile(positive, _FLOOR_QUANTILE)
    lit = np.where(known, np.maximum(flux, floor), floor).astype(np.float32)
    if lit.max() < _EVEN * floor:
        return tone_mapped(flux, float(lit.max()) / 2**stops)
    linear = _local(lit) if tone == "local" else _by_opencv(lit, tone)
    level = float(np.quantile(linear[known], _WHITE_QUANTILE)) or 1.0
    return tone_mapped(np.where(known, linear, np.nan), level / 2**stops)


def _by_opencv(flux: NDArray[np.float32], tone: Tone) -> NDArray[np.float32]:
    """Compress flux with an operator of OpenCV: to linear, from 0 to 1. A larger range is first compressed evenly."""
    import cv2

    relative = flux / flux.max()
    decades = -float(np.log10(relative.min()))
    held = np.asarray(relative ** min(1.0, _OPENCV_DECADES / max(decades, 1e-6)), np.float32)
    coloured = held if held.ndim == 3 else np.repeat(held[..., None], 3, axis=-1)
    operator: Any
    match tone:
        case "reinhard":
            operator = cv2.createTonemapReinhard(1.0, 0.0, 0.5, 0.0)
        case "drago":
            operator = cv2.createTonemapDrago(1.0)
        case _:
            operator = cv2.createTonemapMantiuk(1.0, 0.7)
    verbosity = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(_ERRORS)  # OpenCV 5.0 warns of its own code
    try:
        toned = np.nan_to_num(operator.process(np.ascontiguousarray(coloured)))
    finally:
        cv2.utils.logging.setLogLevel(verbosity)
    return np.asarray(np.clip(toned if held.ndim == 3 else toned[..., 0], 0, 1), np.float32)


def _local(flux: NDArray[np.float32]) -> NDArray[np.float32]:
    """Compress the light of each region and keep the details in it, with a guided filter (He et al. 2013) of the logarithm."""
    import cv2

    brightness = flux if flux.ndim == 2 else flux.mean(axis=-1)
    stops = np.asarray(np.log2(brightness), np.float32)
    side = 2 * max(2, round(max(stops.shape) * _BASE_SHARE)) + 1

    def mean(image: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(cv2.blur(image, (side, side), borderType=cv2.BORDER_REFLECT), np.float32)

    average = mean(stops)
    variance = np.maximum(mean(np.asarray(stops * stops, np.float32)) - average * average, 0)
    gain = np.asarray(variance / (variance + np.float32(_BASE_EDGE**2)), np.float32)
    base = mean(gain) * stops + mean(np.asarray((1 - gain) * average, np.float32))
    dark, bright = np.quantile(base, (1 - _WHITE_QUANTILE, _WHITE_QUANTILE))
    factor = np.float32(min(1.0, _BASE_STOPS / max(float(bright - dark), 1e-6)))
    change = np.exp2((factor - 1) * (base - np.float32(bright)))
    return np.asarray(flux * (change if flux.ndim == 2 else change[..., None]), np.float32)
