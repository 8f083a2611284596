"""Exponential and logarithm of stacks of 3x3 matrices.

A homography is a matrix up to scale; with determinant 1 it is an element of the group SL(3), and its logarithm, of trace 0,
one of the algebra sl(3). The results do not depend on the origin and unit of pixel coordinates.
"""

from __future__ import annotations

import numpy as np

from photonpano import FloatArray

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
