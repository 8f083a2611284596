"""Cubic interpolation in the group of the homographies."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from photonpano import FloatArray, LocationError
from photonpano.geometry import apply, corners, inverse
from photonpano_core.configs import LieConfig
from photonpano_core.group_spline import GroupTrajectory
from photonpano_core.lucas_kanade import interpolating_spline
from photonpano_core.sl3 import exponential, logarithm, unimodular

DEGREE = 3
MAX_ITERATIONS = 50
PASSED_PX = 1e-7
"""A curve that misses its knots by less, at the corners of the frame, goes through them."""


class LieInterpolator:
    """Puts a curve with a continuous acceleration through the knots: a cumulative cubic B-spline.

    For a camera that is only shifted it is the curve of `lucas-kanade`; for one that turns about a fixed axis the angle is.
    """

    def __init__(self, config: LieConfig, frame_shape: tuple[int, int]) -> None:
        """Take the (height, width) of a frame, whose corners tell what is near enough."""
        self._config = config
        self._corners = corners(frame_shape)

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> GroupTrajectory:
        """Interpolate; the information is not used, since the curve goes through every knot.

        Raises:
            LocationError: knots are half a turn or more apart, or they turn too fast, or lie too unevenly, for such a curve.
        """
        del information
        hold = self._config.hold_frames
        if len(instants) < 3:
            return GroupTrajectory(instants, homographies, DEGREE, hold)
        spline = interpolating_spline(instants, np.zeros(len(instants)), DEGREE)
        collocation = splu(BSpline.design_matrix(instants, spline.t, spline.k).tocsc())
        controls = unimodular(homographies)
        for _ in range(MAX_ITERATIONS):
            curve = GroupTrajectory(instants, controls, DEGREE, hold)
            missed = inverse(curve.at(instants)) @ homographies
            if np.abs(apply(missed, self._corners) - self._corners).max() < PASSED_PX:
                return curve
            errors = logarithm(unimodular(missed))
            if np.isnan(errors).any():
                break
            # Spread over the control points as in a vector space, which is right but for the turns between them.
            changes = collocation.solve(errors.reshape(-1, 9)).reshape(-1, 3, 3)
            if np.abs(np.linalg.eigvals(changes)).max() > np.pi:
                break
            controls = controls @ exponential(changes)
        raise LocationError(
            "the located exposures turn too fast, or lie too unevenly in time, for a smooth curve of homographies through all "
            "of them; interpolate with geodesic, lucas-kanade or smoothing-spline"
        )
