"""Corrections of a path by groups that were located: what is slow, and what exceeds their noise."""

from __future__ import annotations

import numpy as np

from photonpano import FloatArray
from photonpano.filtering import exceeding_noise

_DEGREE = 5  # degree of the polynomial in time that is always kept: gauge and drift


def exceeding_noise_of_poses(moves: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return what of some moves of poses is slow, or exceeds the noise: the prior of a smooth motion.

    Args:
        moves: (N, 6) px, in order of time.
        covariance: (N, 6, 6) of the noise of each, whatever that of the others.

    Returns:
        (N, 6).
    """
    times = np.linspace(-1, 1, len(moves))
    basis = np.polynomial.legendre.legvander(times, min(_DEGREE, len(moves) - 1))
    slow = basis @ np.linalg.lstsq(basis, moves, rcond=None)[0]
    # In these modes, errors are independent of each other.
    _, modes = np.linalg.eigh(np.linalg.inv(covariance).mean(axis=0))
    variances = np.einsum("ka,nkl,la->na", modes, covariance, modes)
    rest = [exceeding_noise(*columns).signal for columns in zip(((moves - slow) @ modes).T, variances.T, strict=True)]
    return np.asarray(slow + np.stack(rest, axis=1) @ modes.T)
