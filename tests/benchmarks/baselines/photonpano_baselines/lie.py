"""A cubic spline in the group of homographies, a baseline: `lie` (after Kim, Kim and Shin 1995)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.sparse.linalg import splu

from photonpano import FloatArray, LocationError
from photonpano.geometry import corners, inverse, normalised, transform_points
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators import HeldTrajectory, exponential, group_steps, interpolating_spline, logarithm, unimodular

DEGREE = 3
MAX_ITERATIONS = 50
TOLERANCE_PX = 1e-7  # converged when the residual of the knots, at the corners of the frame, is below this


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
            if np.abs(transform_points(residuals, self._corners) - self._corners).max() < TOLERANCE_PX:
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


class GroupTrajectory(HeldTrajectory):
    """A cumulative B-spline of homographies, frame to reference plane; the curve does not depend on the plane.

    A B-spline with control points C[j] is C[0] + sum of w[j](t) (C[j] - C[j-1]), where w[j] is the sum of the basis functions
    from the j-th on. With products for sums it is a curve of homographies (Kim, Kim and Shin 1995), as smooth as its basis:

        H(t) = C[0] (C[0]^-1 C[1])^w[1](t) (C[1]^-1 C[2])^w[2](t) ...
    """

    def __init__(self, instants: FloatArray, controls: FloatArray, degree: int, hold_frames: float | None) -> None:
        """Take a (3, 3) control point for each instant, (N,); raises a `LocationError` if a step has no real logarithm."""
        super().__init__(instants, hold_frames)
        spline = interpolating_spline(instants, np.zeros(len(instants)), degree)
        self._knots, self._degree = spline.t, spline.k
        self._controls = unimodular(controls if len(instants) > 1 else np.repeat(controls, 2, axis=0))
        self._steps = group_steps(instants, self._controls)
        self._velocities = [self._velocity(end) for end in (self._first, self._last)]

    def _extrapolated(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        start, weights = self._weights(inside)
        result = self._controls[start]
        for order in range(1, self._degree + 1):
            result = result @ exponential(weights[:, order, None, None] * self._steps[start + order - 1])
        for velocity, out in zip(self._velocities, (beyond < 0, beyond > 0), strict=True):
            result[out] = result[out] @ exponential(beyond[out, None, None] * velocity)
        return normalised(result)

    def _weights(self, instants: FloatArray) -> tuple[NDArray[np.integer], FloatArray]:
        """Return, for N instants, the first control point with influence, and the weights of it and those that follow."""
        basis = BSpline.design_matrix(instants, self._knots, self._degree)
        shape = len(instants), self._degree + 1
        values, columns = basis.data.reshape(shape), basis.indices.reshape(shape)
        return columns[:, 0], np.cumsum(values[:, ::-1], axis=1)[:, ::-1]

    def _velocity(self, instant: float) -> FloatArray:
        """Return the (3, 3) logarithm of the motion per frame, in pixels of the frame."""
        start, weights = (array[0] for array in self._weights(np.array([instant])))
        # Each weight is itself a spline, whose coefficients step from 0 to 1.
        steps = np.greater_equal.outer(np.arange(len(self._controls)), start + np.arange(self._degree + 1))
        rates = BSpline(self._knots, steps.astype(np.float64), self._degree).derivative()(instant)
        velocity = np.zeros((1, 3, 3))
        for order in range(1, self._degree + 1):
            step = self._steps[[start + order - 1]]
            velocity = exponential(-weights[order] * step) @ velocity @ exponential(weights[order] * step) + rates[order] * step
        return velocity
