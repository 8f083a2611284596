"""Cumulative B-splines in the group of the homographies: products of powers in place of weighted sums."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from photonpano import FloatArray, LocationError
from photonpano.geometry import normalised
from photonpano_core.extrapolation import HeldTrajectory
from photonpano_core.lucas_kanade import interpolating_spline
from photonpano_core.sl3 import exponential, logarithm, unimodular


class GroupTrajectory(HeldTrajectory):
    """A cumulative B-spline of homographies.

    A B-spline with control points C[j] is C[0] + sum of w[j](t) (C[j] - C[j-1]), where w[j] is the sum of the basis functions
    from the j-th on. With products for sums it is a curve of homographies (Kim, Kim and Shin 1995), as smooth as its basis:

        H(t) = C[0] (C[0]^-1 C[1])^w[1](t) (C[1]^-1 C[2])^w[2](t) ...

    Convention:
        Homographies map pixels of a frame to those of a reference plane. In another reference plane the curve is the same.
    """

    def __init__(self, instants: FloatArray, controls: FloatArray, degree: int, hold_frames: float | None) -> None:
        """Take one (3, 3) control point for each of the (N,) instants; too few of them give a lower degree.

        Raises:
            LocationError: the motion from a control point to the next has no real logarithm.
        """
        super().__init__(instants, hold_frames)
        spline = interpolating_spline(instants, np.zeros(len(instants)), degree)
        self._knots, self._degree = spline.t, spline.k
        self._controls = unimodular(controls if len(instants) > 1 else np.repeat(controls, 2, axis=0))
        self._steps = logarithm(np.linalg.inv(self._controls[:-1]) @ self._controls[1:])
        for missing in np.flatnonzero(np.isnan(self._steps[:, 0, 0])):
            raise LocationError(
                f"from frame {instants[missing]:g} to frame {instants[missing + 1]:g} the motion would turn by half a turn or "
                "more, or into a mirror image, and so has no real logarithm; interpolate with lucas-kanade or "
                "smoothing-spline, which need none, or locate more exposures in between"
            )
        self._velocities = [self._velocity(end) for end in (self._first, self._last)]

    def _moved_on(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        start, weights = self._weights(inside)
        result = self._controls[start]
        for order in range(1, self._degree + 1):
            result = result @ exponential(weights[:, order, None, None] * self._steps[start + order - 1])
        for velocity, out in zip(self._velocities, (beyond < 0, beyond > 0), strict=True):
            result[out] = result[out] @ exponential(beyond[out, None, None] * velocity)
        return normalised(result)

    def _weights(self, instants: FloatArray) -> tuple[NDArray[np.integer], FloatArray]:
        """Return, for N instants, the first control point that counts, and the weights of it and those that follow."""
        basis = BSpline.design_matrix(instants, self._knots, self._degree)
        shape = len(instants), self._degree + 1
        values, columns = basis.data.reshape(shape), basis.indices.reshape(shape)
        return columns[:, 0], np.cumsum(values[:, ::-1], axis=1)[:, ::-1]

    def _velocity(self, instant: float) -> FloatArray:
        """Return the (3, 3) logarithm of the motion in a frame, in pixels of the frame."""
        start, weights = (array[0] for array in self._weights(np.array([instant])))
        # Each weight is a spline itself, one whose coefficients are a step from 0 to 1.
        steps = np.greater_equal.outer(np.arange(len(self._controls)), start + np.arange(self._degree + 1))
        rates = BSpline(self._knots, steps.astype(np.float64), self._degree).derivative()(instant)
        velocity = np.zeros((1, 3, 3))
        for order in range(1, self._degree + 1):
            step = self._steps[[start + order - 1]]
            velocity = exponential(-weights[order] * step) @ velocity @ exponential(weights[order] * step) + rates[order] * step
        return velocity
