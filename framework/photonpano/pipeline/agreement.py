"""Do two exposures show the same place? What every loop closure must pass before it may pull at the others."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano.geometry import rescaled, rescaling, translation
from photonpano.photometry import noise_free_correlation

if TYPE_CHECKING:
    from photonpano.values import FluxImage, Homography, VirtualExposure

_BLOCK = 4
"""Averages of so many pixels squared are compared: what motion blurs differently does not count, and noise counts less."""


def agreement(moving: VirtualExposure, fixed: VirtualExposure, homography: Homography) -> float:
    """Return how alike two exposures are under a motion: the correlation they would have without photon noise.

    Args:
        moving: one exposure.
        fixed: another one, of the same scale.
        homography: (3, 3), pixels of the moving exposure's frame to pixels of the fixed one's.

    Returns:
        1 for the same place, around 0 for different ones; 0 where little is seen by both, or only noise is.
    """
    height, width = (side // _BLOCK for side in moving.flux.shape)
    if not height * width:
        return 0.0
    # From numbers of blocks to the top left pixels of the averages in the other exposure that lie closest: interpolation
    # between averages would change their noise.
    half = (_BLOCK - 1) / 2
    to_fixed = translation(-half, -half) @ rescaled(homography, moving.scale) @ rescaling(_BLOCK)
    first, first_variance = (image[::_BLOCK, ::_BLOCK][:height, :width] for image in _averages(moving))
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    second, second_variance = (
        cv2.warpPerspective(image, to_fixed, (width, height), flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        for image in _averages(fixed)
    )
    both = np.isfinite(first) & np.isfinite(second)
    if not both.any():
        return 0.0
    noise = float(first_variance[both].mean()), float(second_variance[both].mean())
    return noise_free_correlation(first[both], second[both].astype(np.float32), noise, float(both.sum()))


def _averages(exposure: VirtualExposure) -> tuple[FluxImage, FluxImage]:
    """Return the average of the block that starts at each pixel, on the scale on which noise is uniform, and its variance.

    They are NaN where not all of the block was seen.
    """
    known = exposure.weight > 0
    values = np.where(known, exposure.response.stabilised(exposure.flux, exposure.weight), np.float32(np.nan))
    variance = np.full_like(values, np.nan)
    variance[known] = exposure.response.stabilised_std(exposure.weight[known]) ** 2 / _BLOCK**2
    kernel = np.full((_BLOCK, _BLOCK), 1 / _BLOCK**2)
    rows, columns = (side - _BLOCK + 1 for side in values.shape)
    mean, mean_variance = (
        np.asarray(cv2.filter2D(image, -1, kernel, anchor=(0, 0))[:rows, :columns], np.float32) for image in (values, variance)
    )
    return mean, mean_variance
