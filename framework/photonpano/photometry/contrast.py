"""Contrast of a scene relative to photon noise."""

from __future__ import annotations

import numpy as np

from photonpano.values import VirtualExposure

_ROWS = 16  # rows of blocks that are sampled
_BLOCK = 4  # side of the blocks, px, whose averages separate scene and noise: averaging reduces the noise and hardly the scene


def signal_to_noise(exposure: VirtualExposure) -> float:
    """Return the standard deviation of the scene over that of a pixel's noise, on the scale where noise is uniform.

    At 1 and below, single pixels are mostly noise, and registration needs larger structures. 0 if there is no contrast.
    """
    flux, weight = _some_rows(exposure.flux), _some_rows(exposure.weight)
    seen = weight > 0
    if not seen.any():
        return 0.0
    values = np.where(seen, exposure.response.stabilised(flux, weight), np.float32(0))
    sums, counts = _block_sums(values), _block_sums(seen.astype(np.float32))
    full = counts == _BLOCK**2
    if np.count_nonzero(full) < 2:
        return 0.0
    noise = float(exposure.response.stabilised_std(np.median(weight[seen], keepdims=True)).item())
    variance = float(np.var(sums[full] / _BLOCK**2)) - noise**2 / _BLOCK**2
    return float(np.sqrt(max(variance, 0.0))) / noise


def _some_rows(image: np.ndarray) -> np.ndarray:
    """Return about `_ROWS` evenly spaced rows of blocks."""
    rows = image[: len(image) // _BLOCK * _BLOCK].reshape(-1, _BLOCK, image.shape[1])
    step = max(1, len(rows) // _ROWS)
    return rows[::step].reshape(-1, image.shape[1])


def _block_sums(image: np.ndarray) -> np.ndarray:
    rows, columns = image.shape[0] // _BLOCK, image.shape[1] // _BLOCK
    blocks = image[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    return np.asarray(blocks.sum(axis=(1, 3)))
