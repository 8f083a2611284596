"""Interpolation of the eight parameters of the homography (paper, section 4, "Interpolate")."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from photonpano.geometry import from_parameters, parameters
from photonpano_core.configs import LucasKanadeConfig
from photonpano_core.extrapolation import HeldTrajectory


def interpolating_spline(instants: NDArray[np.float64], values: NDArray[np.float64], degree: int = 3) -> BSpline:
    """Return the spline through (N, K) values; too few knots give a lower degree, and a single one a constant."""
    if len(instants) == 1:
        instants, values = np.array([instants[0], instants[0] + 1]), np.repeat(values, 2, axis=0)
    return make_interp_spline(instants, values, k=min(degree, len(instants) - 1))


class ParameterTrajectory(HeldTrajectory):
    """A spline of p1..p8."""

    def __init__(self, instants: NDArray[np.float64], spline: BSpline, hold_frames: float | None) -> None:
        super().__init__(instants, hold_frames)
        self._spline = spline
        self._velocity = spline.derivative()

    def _moved_on(self, inside: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.float64]:
        return from_parameters(self._spline(inside) + self._velocity(inside) * beyond[:, None])


class LucasKanadeInterpolator:
    """Puts a cubic spline of p1..p8 through the knots."""

    def __init__(self, config: LucasKanadeConfig) -> None:
        self._config = config

    def fit(
        self,
        instants: NDArray[np.float64],
        homographies: NDArray[np.float64],
        information: NDArray[np.float64] | None,
    ) -> ParameterTrajectory:
        """Interpolate; the information is not used, since the spline goes through every knot."""
        del information
        spline = interpolating_spline(instants, parameters(homographies))
        return ParameterTrajectory(instants, spline, self._config.hold_frames)
