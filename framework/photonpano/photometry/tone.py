"""Tone curves: flux to pictures, and back."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def srgb_to_linear(encoded: NDArray[np.floating]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1): encoded values in [0, 1] to linear intensities in [0, 1]."""
    encoded = np.asarray(encoded, dtype=np.float32)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((np.maximum(encoded, 0) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Apply the sRGB curve: linear intensities, clipped to [0, 1], to encoded values in [0, 1]. NaN stays NaN."""
    linear = np.clip(np.asarray(linear, dtype=np.float32), 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def tone_mapped(flux: NDArray[np.float32], white: float, *, srgb: bool = True) -> NDArray[np.uint8]:
    """Return a picture of 8 bits: `white` photons per pixel per frame become 255, unknown pixels are black.

    Args:
        flux: photons per pixel per frame, NaN where unknown.
        white: flux that becomes white, as does any higher one.
        srgb: whether levels follow the sRGB curve, for screens, or are proportional to the flux.
    """
    level = linear_to_srgb(flux / white) if srgb else np.clip(flux / white, 0, 1)
    return np.asarray(np.nan_to_num(level) * 255 + 0.5).astype(np.uint8)
