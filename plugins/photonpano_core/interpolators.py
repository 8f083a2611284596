"""Interpolators `lucas-kanade`, `geodesic` and `smoothing-spline`, and the trajectories that they fit.

The first two pass through every knot. The third is a smoothing spline of the eight parameters of the homography, whose
smoothness is estimated from the noise of the knots.

A homography is a matrix up to scale; with determinant 1 it is an element of the group SL(3), and its logarithm, of trace 0,
one of the algebra sl(3). The exponential and the logarithm do not depend on the origin and unit of pixel coordinates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.interpolate import BSpline, make_interp_spline
from scipy.linalg import cho_solve_banded, cholesky_banded, hadamard, solveh_banded

from photonpano import FloatArray, LocationError
from photonpano.filtering import smooth_share
from photonpano.geometry import corners, from_parameters, jacobian, normalised, parameters, transform_points
from photonpano_core.configs import InterpolatorConfig

_TERMS = 19  # of the exponential series; for eigenvalues below 1 the remainder is below 1 / 19!, a rounding error
_SMALL = 0.2  # eigenvalue of the logarithm below which eight terms of its series are exact to rounding
# Newton iterations of a square root, which converge quadratically
_ITERATIONS = 10


def unimodular(matrices: FloatArray) -> FloatArray:
    """Scale (..., 3, 3) matrices so that their determinant is 1."""
    return np.asarray(matrices / np.cbrt(np.linalg.det(matrices))[..., None, None])


def exponential(matrices: FloatArray) -> FloatArray:
    """Return the matrix exponentials of (N, 3, 3) matrices."""
    # Coefficients of the characteristic polynomials x^3 - trace x^2 + minors x - determinant.
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(matrices, 0, -1)
    trace, determinant = a + e + i, np.linalg.det(matrices)
    minors = (a * e - b * d) + (a * i - c * g) + (e * i - f * h)
    # Bound of the eigenvalues (Fujiwara): halve the matrix until it is below 1, and square the result as often.
    largest = 2 * np.maximum(np.maximum(np.abs(trace), np.sqrt(np.abs(minors))), np.cbrt(np.abs(determinant)))
    halvings = np.ceil(np.log2(np.maximum(largest, 1)))
    scale = 0.5**halvings
    trace, minors, determinant = trace * scale, minors * scale**2, determinant * scale**3
    # Cayley-Hamilton: every power of A, and so the series, is a combination of I, A and A^2.
    power = (np.ones_like(trace), np.zeros_like(trace), np.zeros_like(trace))
    series = np.array(power)
    for term in range(1, _TERMS):
        one, first, second = power
        power = (determinant * second / term, (one - minors * second) / term, (first + trace * second) / term)
        series += power
    scaled = matrices * scale[:, None, None]
    one, first, second = series[..., None, None]
    result = one * np.eye(3) + first * scaled + second * (scaled @ scaled)
    for done in range(int(halvings.max(initial=0))):
        more = halvings > done
        result[more] = result[more] @ result[more]
    return np.asarray(result)


def logarithm(matrices: FloatArray) -> FloatArray:
    """Return the principal logarithms of (N, 3, 3) matrices of determinant 1.

    They are NaN where there is none that is real, or one has an eigenvalue above pi: the matrix mirrors, turns by half a turn
    or more, or magnifies more than twentyfold.
    """
    with np.errstate(divide="ignore"):
        size = np.abs(np.log(np.linalg.eigvals(matrices).astype(complex))).max(axis=-1)
    exists = size < np.pi
    target = np.where(exists[:, None, None], matrices, np.eye(3))
    roots = int(np.ceil(np.log2(max(_SMALL, *size[exists]) / _SMALL)))
    for _ in range(roots):
        other = np.broadcast_to(np.eye(3), target.shape)  # Denman and Beavers
        for _ in range(_ITERATIONS):
            target, other = (target + np.linalg.inv(other)) / 2, (other + np.linalg.inv(target)) / 2
    eye = np.eye(3)
    z = (target - eye) @ np.linalg.inv(target + eye)
    square = z @ z
    series = np.zeros_like(z)
    for odd in range(15, 0, -2):
        series = series @ square + eye / odd
    return np.where(exists[:, None, None], 2 ** (roots + 1) * z @ series, np.nan)


_FEWEST_BENT = 6  # knots that show whether accelerations predict anything


class LucasKanadeInterpolator:
    """Fits a cubic spline of p1..p8 through the knots (paper, section 4, "Interpolate")."""

    def __init__(self, config: InterpolatorConfig) -> None:
        self._config = config

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> _ParameterTrajectory:
        """Interpolate through every knot."""
        del information
        spline = interpolating_spline(instants, parameters(homographies))
        return _ParameterTrajectory(instants, spline, self._config.hold_frames)


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


class _SplinePath(HeldTrajectory):
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


class _ParameterTrajectory(_SplinePath):
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

    Raises a `LocationError` if a step has no real logarithm.
    """
    steps = logarithm(np.linalg.inv(knots[:-1]) @ knots[1:])
    for missing in np.flatnonzero(np.isnan(steps[:, 0, 0])):
        raise LocationError(
            f"from frame {instants[missing]:g} to frame {instants[missing + 1]:g} the motion turns by half a turn or more, "
            "or mirrors the image, so that it has no real logarithm; interpolate with lucas-kanade or smoothing-spline, "
            "which need none, or locate more exposures in between"
        )
    return steps


_ORDER = 3  # of the derivative that is penalised: parabolas, which fit any three knots, are not
# Candidates for the scale of the jerk, from a parabola to interpolation. The number of knots averaged grows with the sixth
# root.
_SCALES = np.logspace(-10, 10, 41)
# Candidates for the noise variance, relative to the squared distance of the quiet modes from a parabola.
_NOISES = np.logspace(-16, 0, 129)
_BENT = 0.25  # share of the time held beyond the ends in which a spline is a parabola: half of the distance of its knots
_TINY = 1e-200  # floor on the noise variance, for knots that lie on a parabola exactly
_MIN_INFORMATION = 1e-8  # floor on the information eigenvalues of a knot, relative to the largest
_MAX_INFORMATION = 0.01**-2  # ceiling on them, in 1 / px^2: numbers that are known better spoil the equations by rounding
# Orthonormal map from the corners' coordinates to modes in px: shift, twist, stretch, shear.
_TO_MODES = np.kron(hadamard(4) / 2, np.eye(2))
# the twists, which a shaking camera hardly excites: it changes perspective less than shift, roll and scale
_QUIET = [2, 3]


class SmoothingSplineInterpolator:
    """Smooths the knots according to their noise, and fits the spline of `lucas-kanade` through them.

    The knots y with information W are moved onto the spline f of degree 5 that minimises

        sum of (y - f)' W (y - f)  +  sum over modes of (integral of the square of the third derivative of f) / scale,

    where y are the modes of the motion of the frame's corners, in px. Each mode has its own scale, which is estimated by
    restricted maximum likelihood with white noise as the jerk. Covariances W^-1 that are given are trusted. Without them,
    corners have equal variances, which are estimated from the twists alone: in the other modes, motion that is too fast for the
    knots looks like noise.
    """

    def __init__(self, config: InterpolatorConfig, frame_shape: tuple[int, int]) -> None:
        """Take the (height, width) of a frame."""
        self._config = config
        self._corners = corners(frame_shape)

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> _ParameterTrajectory:
        """Smooth; without information, corners have equal, independent errors. Up to three knots are interpolated."""
        if len(instants) > _ORDER:
            homographies = self._smoothed(instants, homographies, information)
        spline = interpolating_spline(instants, parameters(homographies))
        return _ParameterTrajectory(instants, spline, self._config.hold_frames, _BENT)

    def fit_turns(
        self, instants: FloatArray, turns: FloatArray, information: FloatArray | None
    ) -> Callable[[FloatArray], FloatArray]:
        """Smooth the rotations of a camera in the same way: see `photonpano.InterpolatesTurns`.

        The scale of the information is trusted. Without it, all rotations have equal and independent errors, whose size is
        estimated.
        """
        if len(instants) > _ORDER:
            covariances: FloatArray = np.broadcast_to(np.eye(3), (len(instants), 3, 3))
            if information is not None:
                covariances = np.asarray(np.linalg.inv(information))
            noise = None if information is None else 1.0
            turns = _smoothed_modes(instants, turns, covariances, range(3), noise)
        return _SplinePath(instants, interpolating_spline(instants, turns), self._config.hold_frames, _BENT).at

    def _smoothed(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> FloatArray:
        """Return the smoothed (N, 3, 3) homographies of the knots."""
        covariances: FloatArray = np.broadcast_to(np.eye(8), (len(instants), 8, 8))
        if information is not None:  # it may be singular
            derivatives = [jacobian(homography, self._corners).reshape(8, 8) for homography in homographies]
            back = np.linalg.inv(_TO_MODES @ derivatives)
            values, vectors = np.linalg.eigh(back.transpose(0, 2, 1) @ information @ back)
            values = np.clip(values, _MIN_INFORMATION * values.max(), _MAX_INFORMATION)
            covariances = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
        paths = transform_points(homographies, self._corners).reshape(-1, 8) @ _TO_MODES.T
        noise = None if information is None else 1.0
        moved = _smoothed_modes(instants, paths, covariances, _QUIET, noise) @ _TO_MODES
        return _from_corners(self._corners, moved.reshape(-1, 4, 2))


def _smoothed_modes(
    instants: FloatArray, knots: FloatArray, covariances: FloatArray, quiet: Sequence[int], noise: float | None = None
) -> FloatArray:
    """Return a smoothing spline at its knots: (N, K).

    With normal noise of the knots, and white noise as the jerk, third differences are normally distributed. The part of them
    that the jerk does not explain is noise (Reinsch 1967; de Hoog and Hutchinson 1987). The (N, K, K) covariances of the knots
    are known up to a factor, `noise`, which is estimated from the `quiet` modes where it is None.
    """
    n_knots, n_modes = knots.shape
    times = instants * ((n_knots - 1) / (instants[-1] - instants[0]))
    difference, jerk = _third_differences(times), _jerk_covariance(times)
    observed = difference @ knots
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    modes = [
        _Mode(observed[:, mode], difference @ sparse.diags_array(variances[:, mode]) @ difference.T, jerk)
        for mode in range(n_modes)
    ]
    every = sparse.kron(difference, sparse.eye_array(n_modes))
    of_knots = sparse.bsr_array((covariances, np.arange(n_knots), np.arange(n_knots + 1)))
    expected = every @ of_knots @ every.T + sparse.kron(jerk, sparse.diags_array(_most_likely_scales(modes, quiet, noise)))
    explained = solveh_banded(_banded(expected, (_ORDER + 1) * n_modes - 1), observed.ravel())
    return np.asarray(knots - (of_knots @ (every.T @ explained)).reshape(n_knots, n_modes))


class _Mode:
    """Likelihood of the third differences of one mode, for each scale of its jerk.

    With the noise variance s and the jerk's variance s l, they are normally distributed with the covariance s (V + l J). The
    deviance is n log s + squares(l) / s + determinants(l), up to a constant.
    """

    def __init__(self, observed: FloatArray, noise: sparse.csr_array, jerk: sparse.csr_array) -> None:
        """Take the (N - 3,) third differences, and their covariances V and J from noise and jerk of unit variance."""
        self.n_observed = len(observed)
        self.scales = _SCALES * np.median(noise.diagonal() / jerk.diagonal())
        # All scales are factorised at once, as blocks of one banded matrix.
        bands, jerks = (_banded(each, _ORDER)[:, None] for each in (noise, jerk))
        factor = cholesky_banded((bands + self.scales[:, None] * jerks).reshape(len(bands), -1))
        solved = cho_solve_banded((factor, False), np.tile(observed, len(self.scales)))
        self.squares: FloatArray = solved.reshape(len(self.scales), -1) @ observed
        self.determinants: FloatArray = 2 * np.log(factor[-1]).reshape(len(self.scales), -1).sum(axis=1)

    def deviances(self, noises: FloatArray) -> FloatArray:
        """Return the deviances, minus twice the log likelihoods, for S variances of the noise: (S, L)."""
        return self.n_observed * np.log(noises)[:, None] + self.squares / noises[:, None] + self.determinants


def _most_likely_scales(modes: Sequence[_Mode], quiet: Sequence[int], noise: float | None) -> list[float]:
    """Return the most likely scale of the jerk of each mode, given the noise, or else that of the quiet modes."""
    if noise is None:
        still = [modes[index] for index in quiet]
        largest = sum(mode.squares[0] for mode in still) / sum(mode.n_observed for mode in still)
        noises = max(largest, _TINY) * _NOISES
        noise = float(noises[np.argmin(sum(mode.deviances(noises).min(axis=1) for mode in still))])
    return [mode.scales[mode.deviances(np.array([noise])).argmin()] for mode in modes]


def _from_corners(here: FloatArray, there: FloatArray) -> FloatArray:
    """Return the homographies that map (4, 2) points to (N, 4, 2) points: (N, 3, 3)."""
    x, y = np.broadcast_to(here, there.shape)[..., None].transpose(2, 0, 1, 3)
    u, v = there[..., None].transpose(2, 0, 1, 3)
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = [
        np.concatenate([x, zero, y, zero, one, zero, -u * x, -u * y], axis=-1),
        np.concatenate([zero, x, zero, y, zero, one, -v * x, -v * y], axis=-1),
    ]
    equations = np.stack(rows, axis=2).reshape(-1, 8, 8)
    return from_parameters(np.linalg.solve(equations, (there - here).reshape(-1, 8, 1))[..., 0])


def _third_differences(times: FloatArray) -> sparse.csr_array:
    """Return the (N - 3, N) map from N values to divided differences: for a cubic, its third derivative."""
    result = sparse.csr_array(sparse.eye_array(len(times)))
    for order in range(1, _ORDER + 1):
        lengths = times[order:] - times[:-order]
        result = sparse.csr_array(sparse.diags_array(order / lengths) @ (result[1:] - result[:-1]))
    return result


def _jerk_covariance(times: FloatArray) -> sparse.csr_array:
    """Return the covariance of third differences of a motion whose jerk is white noise of unit density: (N - 3, N - 3).

    Each is the average of the jerk, weighted by a B-spline over four instants (Peano kernel).
    """
    nodes, weights = np.polynomial.legendre.leggauss(_ORDER)
    halves = np.diff(times)[:, None] / 2
    points = times[:-1, None] + halves * (1 + nodes)
    padded = np.pad(times, _ORDER - 1, mode="edge")
    # B-splines at the ends have coinciding knots, and average over fewer instants.
    splines = BSpline.design_matrix(points.ravel(), padded, _ORDER - 1)[:, _ORDER - 1 : 1 - _ORDER]
    averages = splines @ sparse.diags_array(_ORDER / (times[_ORDER:] - times[:-_ORDER]))
    return sparse.csr_array(averages.T @ sparse.diags_array((halves * weights).ravel()) @ averages)


def _banded(matrix: sparse.csr_array, width: int) -> FloatArray:
    """Return the diagonals of a symmetric matrix in the upper form of LAPACK: (width + 1, N)."""
    width = min(width, matrix.shape[0] - 1)
    return np.stack([np.pad(matrix.diagonal(offset), (offset, 0)) for offset in range(width, -1, -1)])
