"""Tone curves: flux to pictures, and back."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Factors of red, green and blue in a picture: all 1, those that make the mean grey, or given ones.
WhiteBalance: TypeAlias = Literal["none", "grey-world"] | tuple[float, float, float]


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
