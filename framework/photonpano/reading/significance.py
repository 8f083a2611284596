"""Significance of a difference between two kinds of neighbours, from its scatter over the image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Minimum score of a difference that is not chance. Scores of noise scatter by 1.2: one in 60,000 exceeds 5.
MIN_SCORE = 5.0
_ROWS = 8  # rows of a unit
_MIN_UNITS = 30  # fewest units whose scatter can be trusted


def units_of(images: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sum images over units of eight rows and one column, which are nearly independent: (k, H, W) becomes (k, units)."""
    bands = images.shape[1] // _ROWS
    if bands >= 2:
        images = images[:, : bands * _ROWS].reshape(len(images), bands, _ROWS, -1).sum(axis=2)
    return images.reshape(len(images), -1)


def score(values: NDArray[np.floating]) -> float:
    """Return the mean of the values of units in its standard errors; 0 if there are fewer than 30 units, or no scatter."""
    if len(values) < _MIN_UNITS:
        return 0.0
    scatter = float(values.std(ddof=1))
    return float(values.mean()) / scatter * float(np.sqrt(len(values))) if scatter > 0 else 0.0
