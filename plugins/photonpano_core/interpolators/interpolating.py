"""Interpolators whose curves pass through every knot: `lucas-kanade`, `geodesic` and `lie`."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from photonpano import FloatArray, LocationError
from photonpano.geometry import apply, corners, inverse, parameters
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators.sl3 import exponential, logarithm, unimodular
from photonpano_core.interpolators.trajectories import GroupTrajectory, ParameterTrajectory, interpolating_spline

DEGREE = 3
MAX_ITERATIONS = 50
TOLERANCE_PX = 1e-7  # converged when the residual of the knots, at the corners of the frame, is below this


class LucasKanadeInterpolator:
    """Fits a cubic spline of p1..p8 through the knots (paper, section 4, "Interpolate")."""

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> ParameterTrajectory:
        """Interpolate through every knot."""
        del information
        spline = interpolating_spline(instants, parameters(homographies))
        return ParameterTrajectory(instants, spline, self._config.hold_frames)


class GeodesicInterpolator:
    """Moves from each knot to the next along a power of the motion between them (Fragneto et al. 2012).

    Between the knots G and H the curve is G (G^-1 H)^s, with s from 0 to 1: the velocity is constant, with a kink at each knot.
    It is the cumulative B-spline of degree 1 whose control points are the knots.
    """

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> GroupTrajectory:
        """Interpolate through every knot; raises a `LocationError` if two knots are half a turn or more apart."""
        del information
        return GroupTrajectory(instants, homographies, 1, self._config.hold_frames)


class LieInterpolator:
    """Fits a curve with continuous acceleration through the knots: a cumulative cubic B-spline.

    For a camera that only shifts it equals the curve of `lucas-kanade`; for a rotation about a fixed axis, the angle is a cubic
    spline.
    """

    def __init__(self, config: InterpolatorConfig, frame_shape: tuple[int, int]) -> None:
        """Take the (height, width) of a frame; the residual is measured at its corners."""
        self._config = config
        self._corners = corners(frame_shape)

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> GroupTrajectory:
        """Interpolate through every knot; raises a `LocationError` if knots are half a turn apart, or nothing converges."""
        del information
        hold = self._config.hold_frames
        if len(instants) < 3:
            return GroupTrajectory(instants, homographies, DEGREE, hold)
        spline = interpolating_spline(instants, np.zeros(len(instants)), DEGREE)
        collocation = splu(BSpline.design_matrix(instants, spline.t, spline.k).tocsc())
        controls = unimodular(homographies)
        for _ in range(MAX_ITERATIONS):
            curve = GroupTrajectory(instants, controls, DEGREE, hold)
            residuals = inverse(curve.at(instants)) @ homographies
            if np.abs(apply(residuals, self._corners) - self._corners).max() < TOLERANCE_PX:
                return curve
            errors = logarithm(unimodular(residuals))
            if np.isnan(errors).any():
                break
            # Errors are distributed over the control points as in a vector space, which is exact without rotation between them.
            changes = collocation.solve(errors.reshape(-1, 9)).reshape(-1, 3, 3)
            if np.abs(np.linalg.eigvals(changes)).max() > np.pi:
                break
            controls = controls @ exponential(changes)
        raise LocationError(
            "no smooth curve of homographies was found through the located exposures: they turn too fast, or lie too unevenly "
            "in time; interpolate with geodesic, lucas-kanade or smoothing-spline"
        )
