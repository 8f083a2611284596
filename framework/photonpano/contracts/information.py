"""Information matrices of pairs: whether one is an inverse covariance, and whether it determines the motion."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from photonpano.geometry import corners, jacobian
from photonpano.values import FloatArray, Located

UNDETERMINED = 10.0  # expected corner error of a pair, in sides of a frame, from which on it constrains nothing
_SAFE = 0.01  # margin of the bound on errors that the smallest pivot gives
_SMALLEST = 1e-100  # floor on eigenvalues
_ASYMMETRY = 1e-3  # largest relative asymmetry that counts as rounding


def is_inverse_covariance(matrix: object) -> bool:
    """Return whether a value is an (8, 8) array of real numbers, finite, symmetric and positive definite."""
    if not (isinstance(matrix, np.ndarray) and matrix.dtype.kind in "fiu" and matrix.shape == (8, 8)):
        return False
    if not np.isfinite(matrix).all() or np.diagonal(matrix).min() <= 0:
        return False
    _, scaled = _scaled(matrix)
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return False
    return bool(np.abs(scaled - scaled.T).max() < _ASYMMETRY)


def why_undetermined(motion: Located, frame_shape: tuple[int, int]) -> str | None:
    """Return why the images of a pair do not determine its motion, in px of a frame; None if they do.

    The expected error of a corner exceeds `UNDETERMINED` times the longer side, as of stripes that move along themselves.
    """
    worst_px, limit_px = motion.residual_px or 0.0, UNDETERMINED * max(frame_shape)
    if motion.information is not None:
        units, scaled = _scaled(motion.information)
        with suppress(np.linalg.LinAlgError):
            # The smallest pivot bounds the errors well enough for all but a few pairs.
            side, pivot = max(frame_shape), np.diagonal(np.linalg.cholesky(scaled)).min()
            if (np.array([*4 * [side], 1, 1, side**2, side**2]) / units).sum() < _SAFE * pivot * limit_px:
                return None
        to_corners = jacobian(motion.homography, corners(frame_shape)).reshape(8, 8)
        values, vectors = np.linalg.eigh(scaled)
        errors = (to_corners / units) @ (vectors / np.sqrt(np.maximum(values, _SMALLEST)))
        worst_px = float(np.sqrt((errors**2).sum(axis=1).max()))
    if worst_px <= limit_px:
        return None
    return f"the images do not determine the motion: its expected error is {worst_px:.2g} px at a corner"


def _scaled(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the square roots of the diagonal, (8,), and the information in units of them: (8, 8) with ones on its diagonal."""
    units = np.sqrt(np.diagonal(information))
    return units, information / (units[:, None] * units)
