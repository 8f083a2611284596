"""A smoothing spline of the eight parameters of the homography, as smooth as the noise of the knots asks for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded, hadamard, solveh_banded

from photonpano import FloatArray
from photonpano.geometry import apply, corners, from_parameters, jacobian, parameters
from photonpano_core.configs import SmoothingSplineConfig
from photonpano_core.lucas_kanade import ParameterTrajectory, interpolating_spline

ORDER = 3
"""Of the derivative that is penalised. A parabola, which fits any three knots, goes free."""
_SCALES = np.logspace(-10, 10, 41)
"""From hardly any jerk, so that a parabola remains, to so much that all knots stay where they are. The number of knots that are
averaged goes with the sixth root."""
_NOISES = np.logspace(-16, 0, 129)
"""Variances of the noise, as shares of how far the quiet modes are from a parabola."""
_TINY = 1e-200
"""The noise of knots that lie on a parabola exactly."""
_LEAST_KNOWN = 1e-8
"""What a knot knows of nothing, as a share of the best known: its error is no more than 10,000 times as large."""
_TO_MODES = np.kron(hadamard(4) / 2, np.eye(2))
"""From the coordinates of the corners to shift, twist, stretch and shear: orthonormal, so that these too are in px."""
_QUIET = [2, 3]
"""The twists. A shaking camera shifts, rolls, perhaps stretches the image, but hardly changes its perspective."""


class SmoothingSplineInterpolator:
    """Moves the knots as far as their noise deserves, and puts the spline of `lucas-kanade` through them.

    They move to the spline f of degree 5 that minimises, over the knots y with their information W,

        sum of (y - f)' W (y - f)  +  sum over modes of (integral of the square of the third derivative of f) / scale,

    where y are the modes of the motion of the frame's corners, in px. So each knot counts for what it knows, direction by
    direction, and each mode is as smooth as it is found to be. The scales, and the factor by which all noise differs from what
    W says, have the restricted maximum likelihood if the jerk is white noise. The factor is found from the modes that a
    trembling camera hardly excites; in the others, motion that is too fast for the knots looks like noise.
    """

    def __init__(self, config: SmoothingSplineConfig, frame_shape: tuple[int, int]) -> None:
        """Take the (height, width) of a frame."""
        self._config = config
        self._corners = corners(frame_shape)

    def fit(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> ParameterTrajectory:
        """Smooth; without information all knots count alike, with equal and independent errors of the corners.

        Up to three knots are interpolated.
        """
        if len(instants) > ORDER:
            homographies = self._smoothed(instants, homographies, information)
        return ParameterTrajectory(instants, interpolating_spline(instants, parameters(homographies)), self._config.hold_frames)

    def _smoothed(self, instants: FloatArray, homographies: FloatArray, information: FloatArray | None) -> FloatArray:
        """Return the (N, 3, 3) homographies of knots after smoothing."""
        covariances = np.broadcast_to(np.eye(8), (len(instants), 8, 8))
        if information is not None:
            slopes = [jacobian(homography, self._corners).reshape(8, 8) for homography in homographies]
            covariances = _covariances(information, _TO_MODES @ slopes)
        paths = apply(homographies, self._corners).reshape(-1, 8) @ _TO_MODES.T
        moved = _smoothed_modes(instants, paths, covariances) @ _TO_MODES
        return _from_corners(self._corners, moved.reshape(-1, 4, 2))


def _smoothed_modes(instants: FloatArray, knots: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return where a smoothing spline passes its knots: (N, 8).

    Noise of the knots, and a jerk that is white noise, both make third differences that are normally distributed. What the jerk
    does not explain of them is noise (Reinsch 1967; de Hoog and Hutchinson 1987).

    Args:
        instants: (N,), more than three.
        knots: (N, 8) modes of the corners, in px.
        covariances: (N, 8, 8) of the knots, up to a common factor.
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
    noise = sparse.bsr_array((covariances, np.arange(n_knots), np.arange(n_knots + 1)))
    expected = every @ noise @ every.T + sparse.kron(jerk, sparse.diags_array(_most_likely_scales(modes)))
    explained = solveh_banded(_banded(expected, (ORDER + 1) * n_modes - 1), observed.ravel())
    return np.asarray(knots - (noise @ (every.T @ explained)).reshape(n_knots, n_modes))


class _Mode:
    """How likely the third differences of one mode are, for each scale of its jerk.

    With the noise variance s and the jerk's variance s l, they are normally distributed with the covariance s (V + l J). So
    minus twice the logarithm of their likelihood is n log s + squares(l) / s + determinant(l), but for a constant.

    Attributes:
        n_observed: n.
        scales: (L,) values of l.
        squares: (L,) of the third differences, divided by V + l J.
        determinants: (L,) logarithms of those of V + l J.
    """

    def __init__(self, observed: FloatArray, noise: sparse.csr_array, jerk: sparse.csr_array) -> None:
        """Take the (N - 3,) third differences, and their covariances due to each."""
        self.n_observed = len(observed)
        self.scales = _SCALES * np.median(noise.diagonal() / jerk.diagonal())
        self.squares, self.determinants = np.empty((2, len(self.scales)))
        noise_bands, jerk_bands = _banded(noise, ORDER), _banded(jerk, ORDER)
        for index, scale in enumerate(self.scales):
            factor = cholesky_banded(noise_bands + scale * jerk_bands)
            self.squares[index] = observed @ cho_solve_banded((factor, False), observed)
            self.determinants[index] = 2 * np.log(factor[-1]).sum()

    def deviances(self, noises: FloatArray) -> FloatArray:
        """Return minus twice the logarithms of the likelihoods with S variances of the noise: (S, L)."""
        return self.n_observed * np.log(noises)[:, None] + self.squares / noises[:, None] + self.determinants


def _most_likely_scales(modes: Sequence[_Mode]) -> list[float]:
    """Return the scale of the jerk of each mode that is most likely, with the noise that is most likely for the quiet ones."""
    quiet = [modes[index] for index in _QUIET]
    largest = sum(mode.squares[0] for mode in quiet) / sum(mode.n_observed for mode in quiet)
    noises = max(largest, _TINY) * _NOISES
    noise = noises[np.argmin(sum(mode.deviances(noises).min(axis=1) for mode in quiet))]
    return [mode.scales[mode.deviances(np.array([noise])).argmin()] for mode in modes]


def _from_corners(here: FloatArray, there: FloatArray) -> FloatArray:
    """Return the homographies that send (4, 2) points to (N, 4, 2) ones: (N, 3, 3)."""
    x, y = np.broadcast_to(here, there.shape)[..., None].transpose(2, 0, 1, 3)
    u, v = there[..., None].transpose(2, 0, 1, 3)
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = [
        np.concatenate([x, zero, y, zero, one, zero, -u * x, -u * y], axis=-1),
        np.concatenate([zero, x, zero, y, zero, one, -v * x, -v * y], axis=-1),
    ]
    equations = np.stack(rows, axis=2).reshape(-1, 8, 8)
    return from_parameters(np.linalg.solve(equations, (there - here).reshape(-1, 8, 1))[..., 0])


def _covariances(information: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return (N, 8, 8) covariances of what has these slopes by p1..p8; a knot may know nothing of a direction."""
    back = np.linalg.inv(slopes)
    values, vectors = np.linalg.eigh(back.transpose(0, 2, 1) @ information @ back)
    values = np.maximum(values, _LEAST_KNOWN * values.max())
    return np.asarray((vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1))


def _third_differences(times: FloatArray) -> sparse.csr_array:
    """Return the (N - 3, N) map from N values to divided differences, which are the third derivatives of cubics."""
    result = sparse.csr_array(sparse.eye_array(len(times)))
    for order in range(1, ORDER + 1):
        lengths = times[order:] - times[:-order]
        result = sparse.csr_array(sparse.diags_array(order / lengths) @ (result[1:] - result[:-1]))
    return result


def _jerk_covariance(times: FloatArray) -> sparse.csr_array:
    """Return the covariance of third differences of a motion whose jerk is white noise of unit density: (N - 3, N - 3).

    Each is the jerk, averaged by a B-spline over four instants (Peano); so it is the integral of products of those.
    """
    nodes, weights = np.polynomial.legendre.leggauss(ORDER)
    halves = np.diff(times)[:, None] / 2
    points = times[:-1, None] + halves * (1 + nodes)
    padded = np.pad(times, ORDER - 1, mode="edge")
    # Those at the ends, with knots that coincide, average over fewer instants.
    splines = BSpline.design_matrix(points.ravel(), padded, ORDER - 1)[:, ORDER - 1 : 1 - ORDER]
    averages = splines @ sparse.diags_array(ORDER / (times[ORDER:] - times[:-ORDER]))
    return sparse.csr_array(averages.T @ sparse.diags_array((halves * weights).ravel()) @ averages)


def _banded(matrix: sparse.csr_array, width: int) -> FloatArray:
    """Return the diagonals of a symmetric matrix as LAPACK's upper form wants them: (width + 1, N)."""
    width = min(width, matrix.shape[0] - 1)
    return np.stack([np.pad(matrix.diagonal(offset), (offset, 0)) for offset in range(width, -1, -1)])
