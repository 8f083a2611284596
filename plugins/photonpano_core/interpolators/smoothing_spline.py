"""A smoothing spline of the eight parameters of the homography, whose smoothness is estimated from the noise of the knots."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded, hadamard, solveh_banded

from photonpano import FloatArray
from photonpano.geometry import corners, from_parameters, jacobian, parameters, transform_points
from photonpano_core.configs import InterpolatorConfig
from photonpano_core.interpolators.interpolating import ParameterTrajectory, SplinePath, interpolating_spline

ORDER = 3  # of the derivative that is penalised: parabolas, which fit any three knots, are not
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

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> ParameterTrajectory:
        """Smooth; without information, corners have equal, independent errors. Up to three knots are interpolated."""
        if len(instants) > ORDER:
            homographies = self._smoothed(instants, homographies, information)
        spline = interpolating_spline(instants, parameters(homographies))
        return ParameterTrajectory(instants, spline, self._config.hold_frames, _BENT)

    def fit_turns(
        self, instants: FloatArray, turns: FloatArray, information: FloatArray | None
    ) -> Callable[[FloatArray], FloatArray]:
        """Smooth the rotations of a camera in the same way: see `photonpano.InterpolatesTurns`.

        The scale of the information is trusted. Without it, all rotations have equal and independent errors, whose size is
        estimated.
        """
        if len(instants) > ORDER:
            covariances: FloatArray = np.broadcast_to(np.eye(3), (len(instants), 3, 3))
            if information is not None:
                covariances = np.asarray(np.linalg.inv(information))
            noise = None if information is None else 1.0
            turns = _smoothed_modes(instants, turns, covariances, range(3), noise)
        return SplinePath(instants, interpolating_spline(instants, turns), self._config.hold_frames, _BENT).at

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
    explained = solveh_banded(_banded(expected, (ORDER + 1) * n_modes - 1), observed.ravel())
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
        self.squares, self.determinants = np.empty((2, len(self.scales)))
        noise_bands, jerk_bands = _banded(noise, ORDER), _banded(jerk, ORDER)
        for index, scale in enumerate(self.scales):
            factor = cholesky_banded(noise_bands + scale * jerk_bands)
            self.squares[index] = observed @ cho_solve_banded((factor, False), observed)
            self.determinants[index] = 2 * np.log(factor[-1]).sum()

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
    for order in range(1, ORDER + 1):
        lengths = times[order:] - times[:-order]
        result = sparse.csr_array(sparse.diags_array(order / lengths) @ (result[1:] - result[:-1]))
    return result


def _jerk_covariance(times: FloatArray) -> sparse.csr_array:
    """Return the covariance of third differences of a motion whose jerk is white noise of unit density: (N - 3, N - 3).

    Each is the average of the jerk, weighted by a B-spline over four instants (Peano kernel).
    """
    nodes, weights = np.polynomial.legendre.leggauss(ORDER)
    halves = np.diff(times)[:, None] / 2
    points = times[:-1, None] + halves * (1 + nodes)
    padded = np.pad(times, ORDER - 1, mode="edge")
    # B-splines at the ends have coinciding knots, and average over fewer instants.
    splines = BSpline.design_matrix(points.ravel(), padded, ORDER - 1)[:, ORDER - 1 : 1 - ORDER]
    averages = splines @ sparse.diags_array(ORDER / (times[ORDER:] - times[:-ORDER]))
    return sparse.csr_array(averages.T @ sparse.diags_array((halves * weights).ravel()) @ averages)


def _banded(matrix: sparse.csr_array, width: int) -> FloatArray:
    """Return the diagonals of a symmetric matrix in the upper form of LAPACK: (width + 1, N)."""
    width = min(width, matrix.shape[0] - 1)
    return np.stack([np.pad(matrix.diagonal(offset), (offset, 0)) for offset in range(width, -1, -1)])
