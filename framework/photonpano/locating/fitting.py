"""Least-squares homographies from matched points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from photonpano.geometry import corners, from_parameters, jacobian, parameters, transform_points
from photonpano.robust import robust_std, soft_l1_weights
from photonpano.values import FloatArray, Homography

# Rounds of reweighting; after 4 the weights of the soft L1 loss change the result by a few per cent of its error.
REWEIGHTINGS = 4
# Lower bound of the position error of a keypoint, px; the residuals of a few matches may be smaller by chance.
MIN_NOISE_PX = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A homography fitted to matches."""

    homography: Homography  # (3, 3), moving to fixed
    information: FloatArray  # (8, 8) inverse covariance of p1..p8
    residual_px: float  # standard deviation of a coordinate of a keypoint of median size, in px

    def corner_std_px(self, shape: tuple[int, int]) -> float:
        """Return the largest expected error of a corner of the frame, in px; infinite if the fit is degenerate."""
        to_corners = jacobian(self.homography, corners(shape)).reshape(8, 8)
        try:
            covariance = to_corners @ np.linalg.inv(self.information) @ to_corners.T
        except np.linalg.LinAlgError:
            return np.inf
        variances = np.diag(covariance).reshape(4, 2).sum(axis=1)
        return float(np.sqrt(variances.max())) if np.all(variances >= 0) else np.inf


def fit_homography(
    moving: NDArray[np.floating],
    fixed: NDArray[np.floating],
    sizes: NDArray[np.floating],
    start: Homography,
    rounding_px: float = 0.0,
) -> Fit:
    """Fit a homography to matches by robust least squares, weighted by the inverse sizes of the keypoints.

    Args:
        moving: (N, 2) points of the moving image.
        fixed: (N, 2) their partners.
        sizes: (N,) diameters of the keypoints; position errors are proportional to them.
        start: (3, 3) initial homography.
        rounding_px: standard deviation of an error common to all matches: keypoints on whole pixels are all rounded alike where
            the camera only shifts.
    """
    here, there = moving.astype(np.float64), fixed.astype(np.float64)
    by_size = (np.median(sizes) / sizes).astype(np.float64)
    p = parameters(start)
    residuals = _residuals(p, here, there, by_size)
    # Iteratively reweighted: scipy's robust losses need a decomposition that takes a hundred times as long.
    for _ in range(REWEIGHTINGS):
        lengths = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
        weights = by_size * np.sqrt(soft_l1_weights(lengths, max(robust_std(residuals), MIN_NOISE_PX)))
        solution = least_squares(_residuals, p, _derivatives, method="lm", x_scale="jac", args=(here, there, weights))
        p = solution.x
        residuals = _residuals(p, here, there, by_size)
    # The RMS, since the median ignores the tails: with it, squared errors of motions from SIFT are three times as large as the
    # information predicts; with the RMS they agree.
    spread = max(np.sqrt(np.sum(residuals**2) / max(1, len(residuals) - len(p))), MIN_NOISE_PX)
    j = _derivatives(p, here, there, by_size)
    information = j.T @ j / spread**2
    if rounding_px:
        shifts = np.diag([0, 0, 0, 0, rounding_px**2, rounding_px**2, 0, 0])
        # (information^-1 + shifts)^-1, without the inverse of an information that may be singular.
        information = information @ np.linalg.inv(np.eye(len(p)) + shifts @ information)
    return Fit(from_parameters(p), information, float(spread))


def _residuals(p: FloatArray, here: FloatArray, there: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted residuals along x and y: (2 N,)."""
    return ((transform_points(from_parameters(p), here) - there) * weights[:, None]).ravel()


def _derivatives(p: FloatArray, here: FloatArray, there: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the derivatives of the residuals: (2 N, 8)."""
    del there
    return (jacobian(from_parameters(p), here) * weights[:, None, None]).reshape(-1, 8)
