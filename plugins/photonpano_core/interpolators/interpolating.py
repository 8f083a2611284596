"""Interpolators through every knot, `lucas-kanade` and `geodesic`, and the trajectories that all interpolators fit."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from photonpano import FloatArray, LocationError
from photonpano.filtering import smooth_share
from photonpano.geometry import from_parameters, normalised, parameters
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators.sl3 import exponential, logarithm, unimodular

_FEWEST_BENT = 6  # knots that show whether accelerations predict anything


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
    """

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> GeodesicTrajectory:
        """Interpolate through every knot; raises a `LocationError` if two knots are half a turn or more apart."""
        del information
        return GeodesicTrajectory(instants, homographies, self._config.hold_frames)


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


class GeodesicTrajectory(HeldTrajectory):
    """Geodesics of homographies, frame to reference plane, from each knot to the next; they do not depend on the plane."""

    def __init__(self, instants: FloatArray, knots: FloatArray, hold_frames: float | None) -> None:
        """Take a (3, 3) knot for each instant, (N,); raises a `LocationError` if a step has no real logarithm."""
        super().__init__(instants, hold_frames)
        if len(instants) == 1:  # it stands still
            instants, knots = np.array([instants[0], instants[0] + 1]), np.repeat(knots, 2, axis=0)
        self._instants, self._knots = instants, unimodular(knots)
        self._velocities = group_steps(instants, self._knots) / np.diff(instants)[:, None, None]

    def _extrapolated(self, inside: FloatArray, beyond: FloatArray) -> FloatArray:
        before = np.clip(np.searchsorted(self._instants, inside, side="right") - 1, 0, len(self._velocities) - 1)
        frames = inside - self._instants[before] + beyond
        return normalised(self._knots[before] @ exponential(frames[:, None, None] * self._velocities[before]))


def group_steps(instants: FloatArray, knots: FloatArray) -> FloatArray:
    """Return the logarithms of the motion from each of N unimodular knots to the next, (N - 1, 3, 3).

    Raises:
        LocationError: a step has no real logarithm.
    """
    steps = logarithm(np.linalg.inv(knots[:-1]) @ knots[1:])
    for missing in np.flatnonzero(np.isnan(steps[:, 0, 0])):
        raise LocationError(
            f"from frame {instants[missing]:g} to frame {instants[missing + 1]:g} the motion turns by half a turn or more, "
            "or mirrors the image, so that it has no real logarithm; interpolate with lucas-kanade or smoothing-spline, "
            "which need none, or locate more exposures in between"
        )
    return steps
