"""Least-squares homographies from matched points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import least_squares

from photonpano.geometry import apply, corners, from_parameters, jacobian, parameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

MIN_NOISE_PX = 0.02
"""Keypoints are not located better than this, however well a few of them agree."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A homography fitted to matches.

    Attributes:
        homography: (3, 3), moving to fixed.
        information: (8, 8) inverse covariance of p1..p8.
        residual_px: robust standard deviation of a coordinate of a keypoint of median size, in px.
    """

    homography: NDArray[np.float64]
    information: NDArray[np.float64]
    residual_px: float

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
    moving: NDArray[np.float32], fixed: NDArray[np.float32], sizes: NDArray[np.float32], start: NDArray[np.float64]
) -> Fit:
    """Fit a homography to matches, robustly (soft L1), each weighted by the inverse of its keypoint's size.

    Args:
        moving: (N, 2) points of the moving image.
        fixed: (N, 2) their partners.
        sizes: (N,) diameters of the keypoints; where a keypoint lies is known in proportion.
        start: (3, 3) where to start from.
    """
    here, there = moving.astype(np.float64), fixed.astype(np.float64)
    weights = (np.median(sizes) / sizes).astype(np.float64)

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return ((apply(from_parameters(p), here) - there) * weights[:, None]).ravel()

    def derivatives(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return (jacobian(from_parameters(p), here) * weights[:, None, None]).reshape(-1, 8)

    first = parameters(start)
    solution = least_squares(
        residuals, first, derivatives, x_scale="jac", loss="soft_l1", f_scale=_spread(residuals(first)), max_nfev=30
    )
    spread = _spread(solution.fun)
    j = derivatives(solution.x)
    return Fit(from_parameters(solution.x), j.T @ j / spread**2, spread)


def _spread(residuals: NDArray[np.float64]) -> float:
    """Return the standard deviation, from the median so that wrong matches do not count."""
    return max(1.4826 * float(np.median(np.abs(residuals))), MIN_NOISE_PX)
