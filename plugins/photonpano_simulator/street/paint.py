"""Paint for the street: patches of colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PATCHES = 240
"""Patches of a street of 2048 px x 1365 px, and of any other that shows as much."""
_HEIGHT, _WIDTH = 1365.0, 2048.0
_STRENGTH = 2.0
"""Standard deviation of the logarithms of red and blue, relative to green, before they are limited."""
_STRONGEST = 1.5
"""Largest such logarithm."""


def paint(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Return factors of red, green and blue whose sum is 1: patches of strong and pale colours, with sharp edges.

    Args:
        shape: (height, width) of the street, px.
        seed: another seed is other patches.

    Returns:
        (height, width, 3).
    """
    height, width = shape
    aspect = (width / height) / (_WIDTH / _HEIGHT)
    rng = np.random.default_rng((seed, 1))
    n_patches = max(8, round(_PATCHES * aspect))
    places = rng.uniform((0, 0), (height, width), (n_patches, 2))
    log_ratios = np.clip(_STRENGTH * rng.standard_normal((n_patches, 2)), -_STRONGEST, _STRONGEST)
    factors = np.exp(np.stack([log_ratios[:, 0], np.zeros(n_patches), log_ratios[:, 1]], axis=-1))
    factors /= factors.sum(axis=-1, keepdims=True)
    nearest = np.empty(shape, np.intp)
    columns = np.arange(width)
    for row in range(height):
        # Of a patch, each row sees the nearest place.
        distances = (places[:, :1] - row) ** 2 + (places[:, 1:] - columns) ** 2
        nearest[row] = distances.argmin(axis=0)
    return np.asarray(factors[nearest], np.float32)
