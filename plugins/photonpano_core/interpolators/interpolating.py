"""Interpolators through every knot, `lucas-kanade`, `geodesic` and `lie`, and the trajectories that all interpolators fit."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse.linalg import splu

from photonpano import FloatArray, LocationError
from photonpano.filtering import smooth_share
from photonpano.geometry import corners, from_parameters, inverse, normalised, parameters, transform_points
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators.sl3 import exponential, logarithm, unimodular

DEGREE = 3
_FEWEST_BENT = 6  # knots that show whether accelerations predict anything
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


def interpolating_spline(instants: FloatArray, values: FloatArray, degree: int = 3) -> BSpline:
    """Return the spline through (N, K) values; the degree is at most N - 1, and a single knot gives a constant."""
    if len(instants) == 1:
        instants, values = np.array([instants[0], instants[0] + 1]), np.repeat(values, 2, axis=0)
    return make_interp_spline(instants, values, k=min(degree, len(instants) - 1))


class HeldTrajectory(ABC):
    """A trajectory that keeps its velocity for a bounded time beyond its ends, and then stands still: polynomials diverge."""

    def __init__(self, instants: FloatArray, hold_frames: float | None) -> None:
        """Take the (N,) increasing instants of the knots; `hold_frames` is twice their mean distance by default."""
        self._first, self._last = float(instants[0]), float(instants[-1])
        spacing = (self._last - self._first) / max(1, len(instants) - 1)
        self._hold = 2 * spacing if hold_frames is None else hold_frames

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        frames = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        inside = np.clip(frames, self._first, self._last)
        return self._extrapolated(inside, np.clip(frames - inside, -self._hold, self._hold))

    @abstractmethod
    def _extrapolated(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        """Return (N, 3, 3), going on from instants `inside` the knots, (N,), at the velocity there for `beyond` frames."""


class SplinePath(HeldTrajectory):
    """A spline of K numbers; `at` returns these, (N, K)."""

    def __init__(self, instants: FloatArray, spline: BSpline, hold_frames: float | None, bent: float = 0.0) -> None:
        """Take a spline, which beyond its ends keeps its acceleration, too, for a share `bent` of the time that is held.

        It keeps it as far as accelerations predict anything, at the mean distance of the knots: see `smooth_share`.
        """
        super().__init__(instants, hold_frames)
        self._spline, self._velocity = spline, spline.derivative()
        self._acceleration, self._bent = None, bent * self._hold
        if bent and len(instants) >= _FEWEST_BENT:
            values = spline(np.linspace(self._first, self._last, len(instants)))
            share = np.array([smooth_share(values[:, [column]]) for column in range(values.shape[1])])
            self._acceleration = share, spline.derivative(2)

    def _extrapolated(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        found = self._spline(inside) + self._velocity(inside) * beyond[:, None]
        if self._acceleration is None:
            return np.asarray(found)
        (share, acceleration), bent = self._acceleration, np.clip(beyond, -self._bent, self._bent)
        return np.asarray(found + share * acceleration(inside) * (bent * (beyond - bent / 2))[:, None])


class ParameterTrajectory(SplinePath):
    """A spline of p1..p8."""

    def _extrapolated(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        return from_parameters(super()._extrapolated(inside, beyond))


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
        self._steps = logarithm(np.linalg.inv(self._controls[:-1]) @ self._controls[1:])
        for missing in np.flatnonzero(np.isnan(self._steps[:, 0, 0])):
            raise LocationError(
                f"from frame {instants[missing]:g} to frame {instants[missing + 1]:g} the motion turns by half a turn or more, "
                "or mirrors the image, so that it has no real logarithm; interpolate with lucas-kanade or smoothing-spline, "
                "which need none, or locate more exposures in between"
            )
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
