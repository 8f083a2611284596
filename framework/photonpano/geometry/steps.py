"""Derivatives of homographies by their eight parameters, in coordinates in which all parameters have about the same effect."""

from __future__ import annotations

from functools import cache

import numpy as np

from photonpano.geometry.homographies import from_parameters
from photonpano.values import FloatArray, Homography


@cache
def unit_coordinates(shape: tuple[int, int]) -> Homography:
    """Return the map from pixels of a (height, width) image to coordinates with -1 and 1 at the ends of its longer side."""
    height, width = shape
    half = max(height, width) / 2
    unit = np.array([[1 / half, 0, (1 - width) / (2 * half)], [0, 1 / half, (1 - height) / (2 * half)], [0, 0, 1]])
    unit.flags.writeable = False
    return unit


@cache
def generators(shape: tuple[int, int]) -> FloatArray:
    """Return the derivatives of a homography of pixels by p1..p8 of `unit_coordinates`, at the identity: (8, 3, 3).

    To first order, a change by p in unit coordinates is the homography I + p1 G1 + ... + p8 G8 of pixels.
    """
    unit = unit_coordinates(shape)
    changes = np.asarray(np.linalg.inv(unit) @ (from_parameters(np.eye(8)) - np.eye(3)) @ unit)
    changes.flags.writeable = False
    return changes


def slopes(mapped: FloatArray, changes: FloatArray) -> FloatArray:
    """Return the derivatives of mapped points by eight parameters: (..., 2 N, 8), x and y of a point in adjacent rows.

    Args:
        mapped: (..., 3, N) points in homogeneous coordinates.
        changes: (..., 8, 3, N) their derivatives with respect to eight parameters.
    """
    depth = mapped[..., None, 2:, :]
    points = mapped[..., None, :2, :] / depth
    d = (changes[..., :2, :] - points * changes[..., 2:, :]) / depth
    return np.asarray(np.moveaxis(d, -3, -1).swapaxes(-3, -2).reshape(*d.shape[:-3], -1, d.shape[-3]))
