"""Phase correlation (Kuglin and Hines 1975): the shift between two images from the phases of their spectra."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano.locating.viewing import View
from photonpano.values import BoolArray, FloatArray

_TAPER = 0.25
"""The window falls to 0 at masked pixels, over this fraction of the shorter side."""


def shift_between(moving: View, fixed: View, peak_px: float = 1.5) -> FloatArray | None:
    """Return the shift (x, y) in px that maps `moving` to `fixed`; None without overlap or without texture.

    Args:
        moving: one image.
        fixed: the other one, on the same grid.
        peak_px: see `shift_by_phase`.
    """
    both = moving.seen & fixed.seen
    if not both.any():
        return None
    # Without a window, the borders, which do not move, would correlate.
    window = _window(both)
    first, second = (window * (view.image - view.image[both].mean()) for view in (moving, fixed))
    return shift_by_phase(first, second, peak_px)


def shift_by_phase(
    moving: NDArray[np.float32], fixed: NDArray[np.float32], peak_px: float, gaussian_peak: bool = True
) -> FloatArray | None:
    """Return the shift (x, y) in px between two windowed images of mean 0; None without texture.

    The inverse transform of the normalised cross-power spectrum peaks at the shift. All frequencies have the same weight in it,
    also those that hold only noise; so it is blurred, which makes the peak a Gaussian.

    Args:
        moving: (H, W) image, 0 at the borders.
        fixed: (H, W) the other image.
        peak_px: standard deviation of the peak, in px.
        gaussian_peak: whether the peak is located by a Gaussian through three values, and not by a parabola.
    """
    spectra = [fft.rfft2(image) for image in (moving, fixed)]
    cross = spectra[1] * spectra[0].conj()
    amplitude = np.abs(cross)
    if not amplitude.max() > 0:
        return None
    height, width = moving.shape
    down, across = np.meshgrid(fft.fftfreq(height), fft.rfftfreq(width), indexing="ij")
    blur = np.exp(-2 * (np.pi * peak_px) ** 2 * (down**2 + across**2))
    surface = fft.irfft2(blur * cross / np.maximum(amplitude, 1e-12 * amplitude.max()), s=moving.shape)
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    y = row + _vertex(surface[[row - 1, row, (row + 1) % height], column], gaussian_peak)
    x = column + _vertex(surface[row, [column - 1, column, (column + 1) % width]], gaussian_peak)
    # Shifts beyond half of the image come out as negative ones.
    return np.array([(x + width / 2) % width - width / 2, (y + height / 2) % height - height / 2])


def _window(seen: BoolArray) -> NDArray[np.float32]:
    """Return 1 inside of what was seen, falling to 0 at its borders."""
    distance = cv2.distanceTransform(np.pad(seen, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    within = np.minimum(distance / (_TAPER * min(seen.shape)), 1)
    return np.asarray(np.sin(np.pi / 2 * within) ** 2, np.float32)


def _vertex(values: FloatArray, gaussian: bool) -> float:
    """Return where the curve through three values is highest, from the middle one, which is the largest of them."""
    before, here, after = np.log(np.maximum(values, 1e-3 * values[1])) if gaussian else values
    curvature = before - 2 * here + after
    return float((before - after) / (2 * curvature)) if curvature < 0 else 0.0
