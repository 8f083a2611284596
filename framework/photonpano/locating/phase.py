"""Phase correlation (Kuglin and Hines 1975): the shift between two images from the phases of their spectra."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano.locating.viewing import View
from photonpano.values import FloatArray

_TAPER = 0.25  # the window falls to 0 at masked pixels, over this fraction of the shorter side


def shift_between(moving: View, fixed: View, peak_px: float = 1.5) -> FloatArray | None:
    """Return the shift (x, y) in px that maps `moving` to `fixed`; None without overlap or without texture.

    Args:
        moving: one image.
        fixed: the other one, on the same grid.
        peak_px: see `shift_of_spectra`.
    """
    both = moving.seen & fixed.seen
    if not both.any():
        return None
    # Without a window, which falls to 0 at the borders of what was seen, these would correlate: they do not move.
    distance = cv2.distanceTransform(np.pad(both, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    window = np.sin(np.pi / 2 * np.minimum(distance / (_TAPER * min(both.shape)), 1)) ** 2
    first, second = (window * (view.image - view.image[both].mean()) for view in (moving, fixed))
    return shift_of_spectra(fft.rfft2(first), fft.rfft2(second), both.shape, peak_px, gaussian_peak=True)


def shift_of_spectra(
    moving: NDArray[np.complexfloating],
    fixed: NDArray[np.complexfloating],
    shape: tuple[int, ...],
    peak_px: float,
    *,
    gaussian_peak: bool,
) -> FloatArray | None:
    """Return the shift (x, y) in px between two windowed images of mean 0, (H, W), from their spectra; None without texture.

    The inverse transform of the normalised cross-power spectrum peaks at the shift. All frequencies have the same weight in it,
    also those that hold only noise; so it is blurred, which makes the peak a Gaussian of the standard deviation `peak_px`. It
    is located by a Gaussian through three values, or by a parabola. The spectra are (H, W // 2 + 1).
    """
    surface = correlation_surface(fixed * moving.conj(), shape, peak_px)
    if surface is None:
        return None
    row, column = np.unravel_index(int(surface.argmax()), surface.shape)
    return _refined(surface, int(row), int(column), gaussian_peak)


def correlation_surface(cross: NDArray[np.complexfloating], shape: tuple[int, ...], peak_px: float) -> FloatArray | None:
    """Return the phase correlation of two images at each cyclic shift, (H, W), row by row from 0; None without texture.

    Args:
        cross: (H, W // 2 + 1) spectrum of the fixed image times the conjugate spectrum of the moving one. Spectra of several
            pairs with one shift may be summed.
        shape: (height, width) of the images.
        peak_px: standard deviation of the peak, in px.
    """
    amplitude = np.abs(cross)
    if not amplitude.max() > 0:
        return None
    return np.asarray(fft.irfft2(_blur(shape, peak_px) * cross / np.maximum(amplitude, 1e-12 * amplitude.max()), s=shape))


def correlation_peaks(surface: FloatArray, least: float, most: int = 8) -> tuple[FloatArray, FloatArray]:
    """Return the shifts (x, y) of the highest local maxima of a phase correlation, (P, 2) in px, and their heights, (P,).

    Args:
        surface: (H, W), from `correlation_surface`.
        least: height of the lowest peak, as a share of the highest.
        most: largest number of peaks, the highest first.
    """
    padded = np.pad(surface.astype(np.float32), 1, mode="wrap")
    highest_near = cv2.dilate(padded, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
    rows, columns = np.nonzero((padded[1:-1, 1:-1] >= highest_near) & (surface >= least * surface.max()))
    order = np.argsort(-surface[rows, columns], kind="stable")[:most]
    shifts = [_refined(surface, int(rows[index]), int(columns[index]), gaussian=True) for index in order]
    return np.array(shifts).reshape(-1, 2), np.asarray(surface[rows[order], columns[order]])


def _refined(surface: FloatArray, row: int, column: int, gaussian: bool) -> FloatArray:
    """Return the shift (x, y) of a local maximum, to a fraction of a pixel."""
    height, width = surface.shape
    y = row + _vertex(surface[[row - 1, row, (row + 1) % height], column], gaussian)
    x = column + _vertex(surface[row, [column - 1, column, (column + 1) % width]], gaussian)
    # Shifts beyond half of the image come out as negative ones.
    return np.array([(x + width / 2) % width - width / 2, (y + height / 2) % height - height / 2])


@cache
def _blur(shape: tuple[int, ...], peak_px: float) -> FloatArray:
    """Return the spectrum of a Gaussian: (H, W // 2 + 1)."""
    height, width = shape
    down, across = np.meshgrid(fft.fftfreq(height), fft.rfftfreq(width), indexing="ij")
    return np.asarray(np.exp(-2 * (np.pi * peak_px) ** 2 * (down**2 + across**2)))


def _vertex(values: FloatArray, gaussian: bool) -> float:
    """Return where the curve through three values is highest, from the middle one, which is the largest of them."""
    before, here, after = np.log(np.maximum(values, 1e-3 * values[1])) if gaussian else values
    curvature = before - 2 * here + after
    return float((before - after) / (2 * curvature)) if curvature < 0 else 0.0
