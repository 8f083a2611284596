"""Hessian and information matrix of an alignment, from moments of image derivatives.

The derivative of a pixel with respect to a parameter of the homography is a derivative of the image times a polynomial in x
and y of degree two at most. So all sums over pixels are moments of a few products, and no image per parameter is computed.
Parameters are p1..p8 in unit coordinates, which run from -1 to 1 along the longer side.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, Homography
from photonpano.compiling import compiled
from photonpano.locating import MIN_COMMON_CURVATURE, PRIOR_STD
from photonpano_direct.moments import Buffers, Layer, derivative_moments, differentiate
from photonpano_direct.small_matrices import cholesky, dot, product, solve_lower, transposed


def _polynomials(terms: dict[int, tuple[tuple[float, int, int], ...]]) -> FloatArray:
    """Return the coefficients of x^i y^j for each parameter: (8, 3, 3)."""
    coefficients = np.zeros((8, 3, 3))
    for parameter, polynomial in terms.items():
        for factor, i, j in polynomial:
            coefficients[parameter, i, j] = factor
    return coefficients


# A small change of p1..p8 moves (x, y) by (p1 x + p3 y + p5 - p7 x^2 - p8 x y, p2 x + p4 y + p6 - p7 x y - p8 y^2).
_X = _polynomials({0: ((1, 1, 0),), 2: ((1, 0, 1),), 4: ((1, 0, 0),), 6: ((-1, 2, 0),), 7: ((-1, 1, 1),)})
_Y = _polynomials({1: ((1, 1, 0),), 3: ((1, 0, 1),), 5: ((1, 0, 0),), 6: ((-1, 1, 1),), 7: ((-1, 0, 2),)})


def _moments_of_products() -> FloatArray:
    """Return the coefficients of the moments of `derivative_moments` for each pair of parameters: (64, 75)."""

    def product(first: FloatArray, second: FloatArray) -> FloatArray:
        result = np.zeros((8, 8, 5, 5))
        for i in range(3):
            for j in range(3):
                result[:, :, i : i + 3, j : j + 3] += first[:, None, i, j, None, None] * second[None]
        return result

    along = product(_X, _X), product(_X, _Y) + product(_Y, _X), product(_Y, _Y)
    return np.stack(along, axis=2).reshape(64, 75)


# Coefficients of moments: (8, 9) of those of `residuals_and_moments` along x and y in the derivative by a parameter, and (64,
# 75) of those of `derivative_moments` in the second derivative by two parameters.
MOMENTS_X, MOMENTS_Y, _MOMENTS_OF_PRODUCTS = _X.reshape(8, 9), _Y.reshape(8, 9), _moments_of_products()


# (8, 8) inverse covariance of p1..p8 in unit coordinates: between two exposures a camera shifts the image by any amount, but
# rolls by 1 or 2 degrees and changes the perspective by little.
PRIOR = np.diag(np.array([PRIOR_STD, PRIOR_STD, PRIOR_STD, PRIOR_STD, np.inf, np.inf, PRIOR_STD, PRIOR_STD]) ** -2.0)


# Places of p1..p8 in a homography, column by column: [[1 + p1, p3, p5], [p2, 1 + p4, p6], [p7, p8, 1]].
_ROWS, _COLUMNS = [0, 1, 0, 1, 0, 1, 2, 2], [0, 0, 1, 1, 2, 2, 0, 1]


class Coordinates(NamedTuple):
    """Unit coordinates of an image of some shape."""

    unit: FloatArray  # (3, 3), pixels to unit coordinates
    generators: FloatArray  # (8, 3, 3), see `photonpano.geometry.generators`
    to_corners: FloatArray  # (8, 8), derivatives of the corners with respect to p1..p8, in px


@compiled
def chance_level(pixels: int, blur_px: float) -> float:
    """Return the curvature that the noise of two images has in common by chance, relative to that of one of them."""
    return float(1 / np.sqrt(pixels / max(1.0, 4 * np.pi * blur_px**2)))


@compiled
def curvatures(moving: Layer, buffers: Buffers, chance: float, floor: float) -> tuple[FloatArray, FloatArray]:
    """Return the (8, 8) Gauss-Newton Hessian of the template, and the part that both images have in common.

    The noise of the template has derivatives too, larger in the dark than those of the scene. The two images have only the
    scene in common. The common curvature of noise by `chance` is subtracted, and eigenvalues stay above `floor`, both relative
    to the template's. The gradients of the buffers are overwritten.
    """
    own = _hessian(moving.gradients, moving.gradients, buffers.weight)
    differentiate(buffers.residual, buffers.gradients)
    difference = _hessian(moving.gradients, buffers.gradients, buffers.weight)
    # Whitened by the template's Hessian, so that all parameters have the same scale.
    root = np.zeros((8, 8))
    if not cholesky(own, root):
        return own, own.copy()
    solve_lower(root, difference)
    whitened = transposed(difference)
    solve_lower(root, whitened)
    for i in range(8):
        whitened[i, i] += 1
    values, vectors = np.linalg.eigh(whitened)
    half = product(root, transposed(vectors.T))  # in C order, for which `product` is compiled
    for i in range(8):
        for j in range(8):
            half[i, j] *= np.sqrt(max(values[j] - chance, floor))
    return own, product(half, transposed(half))


@compiled
def _hessian(first: NDArray[np.float32], second: NDArray[np.float32], weight: NDArray[np.float32]) -> FloatArray:
    """Return (8, 8) weighted sums of products of derivatives by two parameters, from (2, H, W) derivatives along x and y."""
    moments = np.empty((3, 5, 5))
    derivative_moments(first, second, weight, moments)
    height, width = weight.shape
    scale = (max(height, width) / 2) ** 2
    hessian = np.empty((8, 8))
    for i in range(8):
        for j in range(8):
            hessian[i, j] = scale * dot(_MOMENTS_OF_PRODUCTS[8 * i + j], moments.reshape(-1))
    return hessian


@compiled
def expected_px(information: FloatArray, basis: FloatArray, to_corners: FloatArray) -> float:
    """Return the expected error of a corner in px if noise is white; 0 if the information is singular.

    `basis` (8, K) are the changes of p1..p8 that are estimated, `to_corners` (8, 8) the derivatives of the corners by p1..p8.
    """
    of_basis, n = transposed(basis), basis.shape[1]
    root, moves = np.zeros((n, n)), transposed(product(to_corners, basis))
    if not cholesky(product(of_basis, product(information, basis)), root):
        return 0.0
    # The trace of J (R R^T)^-1 J^T is the sum of the squares of R^-1 J^T.
    solve_lower(root, moves)
    squares = 0.0
    for i in range(moves.shape[0]):
        squares += dot(moves[i], moves[i])
    return float(np.sqrt(squares / 4))


def information_of(
    moving: Layer,
    buffers: Buffers,
    homography: Homography,
    pixels: int,
    weights: float,
    noise_ratio: float,
    coordinates: Coordinates,
) -> tuple[FloatArray, float, float]:
    """Return the inverse covariance of p1..p8, (8, 8), and the expected error of a corner in px, infinite without texture.

    The third result is the share of the template's curvature that both images have in common. Residual and weight of the
    buffers come from `residuals_and_moments`, and all are overwritten. `noise_ratio` is the mean squared residual relative to
    that of photon noise.
    """
    own, hessian = curvatures(moving, buffers, chance_level(pixels, moving.blur_px), MIN_COMMON_CURVATURE)
    # The blur correlates the noise of neighbours, so the step scatters by H^-1 M H^-1 and not by H^-1. Weights and positions
    # hardly change within the blur, so M needs only blurred gradients.
    np.multiply(buffers.weight, buffers.weight, out=buffers.weight)
    np.multiply(buffers.weight, np.float32(pixels / weights), out=buffers.weight)
    scatter, root = _hessian(moving.smoothed, moving.smoothed, buffers.weight), np.zeros((8, 8))
    if not cholesky(scatter, root):
        return PRIOR.copy(), np.inf, 0.0
    # Few rows that overlap show nothing of some directions.
    common = float(np.trace(np.linalg.pinv(own, hermitian=True) @ hessian)) / 8
    solve_lower(root, hessian)
    information = hessian.T @ hessian / max(1.0, noise_ratio) + PRIOR
    std_px = expected_px(information, np.eye(8), coordinates.to_corners)
    # From steps in unit coordinates of the template to p1..p8 of the homography, with h33 = 1.
    changed = homography @ coordinates.generators
    to_parameters = (changed - homography * changed[:, 2:, 2:])[:, _ROWS, _COLUMNS].T
    to_step = np.linalg.inv(to_parameters)
    return to_step.T @ information @ to_step, std_px if std_px > 0 else np.inf, common
