"""What the pixels of two images tell about a small change of a homography, and how well it is known.

A parameter changes a pixel by its derivative times a polynomial of its place of degree two at most. So sums over all pixels are
moments of a few products, and no image for each parameter is ever made. Parameters are those of coordinates that run from -1 to
1 along the longer side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano_direct.layers import Layer
from photonpano_direct.moments import Buffers, differentiate, products
from photonpano_direct.small_matrices import cholesky, dot, product, solve_lower, transposed

_BY_CHANCE = 1.0
"""The best alignment of noise has a curvature in common of up to so many times what noise has in common anywhere; that much
tells nothing."""
_UNKNOWN = 1e-3
"""Where no more than that is in common, next to nothing is known: this share of the template's curvature."""


def _polynomials(terms: dict[int, tuple[tuple[float, int, int], ...]]) -> NDArray[np.float64]:
    """Return the coefficients of x^i y^j for each parameter: (8, 3, 3)."""
    coefficients = np.zeros((8, 3, 3))
    for parameter, polynomial in terms.items():
        for factor, i, j in polynomial:
            coefficients[parameter, i, j] = factor
    return coefficients


# A small change of p1..p8 moves (x, y) by (p1 x + p3 y + p5 - p7 x^2 - p8 x y, p2 x + p4 y + p6 - p7 x y - p8 y^2).
_X = _polynomials({0: ((1, 1, 0),), 2: ((1, 0, 1),), 4: ((1, 0, 0),), 6: ((-1, 2, 0),), 7: ((-1, 1, 1),)})
_Y = _polynomials({1: ((1, 1, 0),), 3: ((1, 0, 1),), 5: ((1, 0, 0),), 6: ((-1, 1, 1),), 7: ((-1, 0, 2),)})


def _products() -> NDArray[np.float64]:
    """Return the coefficients of the sums of `products` in the product of two parameters: (64, 75)."""

    def product(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
        result = np.zeros((8, 8, 5, 5))
        for i in range(3):
            for j in range(3):
                result[:, :, i : i + 3, j : j + 3] += first[:, None, i, j, None, None] * second[None]
        return result

    along = product(_X, _X), product(_X, _Y) + product(_Y, _X), product(_Y, _Y)
    return np.stack(along, axis=2).reshape(64, 75)


ALONG_X, ALONG_Y, PRODUCTS = _X.reshape(8, 9), _Y.reshape(8, 9), _products()
"""What the sums of `look` along x and along y, and those of `products`, have to do with each parameter or two."""


@compiled
def by_chance(pixels: int, blur_px: float) -> float:
    """Return the curvature that the noise of two images has in common by chance, as a share of that of one of them."""
    return float(1 / np.sqrt(pixels / max(1.0, 4 * np.pi * blur_px**2)))


@compiled
def curvatures(moving: Layer, buffers: Buffers, chance: float, least: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (8, 8) curvature of the template, and that which both images have in common: that of the scene.

    The noise of the template has derivatives too, and in the dark larger ones than the scene. With those of the other image it
    has nothing in common.

    Args:
        moving: the template.
        buffers: residual and weight as `look` left them; the gradients are overwritten.
        chance: the share of the template's curvature that noise may have in common, which is taken off.
        least: what is left of a direction in which there is nothing in common, as a share of the template's curvature.
    """
    own = quadratic(moving.gradients, moving.gradients, buffers.weight)
    differentiate(buffers.residual, buffers.gradients)
    difference = quadratic(moving.gradients, buffers.gradients, buffers.weight)
    # In units in which the template's is the identity, so that no parameter drowns another.
    root = np.zeros((8, 8))
    if not cholesky(own, root):
        return own, own.copy()
    solve_lower(root, difference)
    whitened = transposed(difference)
    solve_lower(root, whitened)
    for i in range(8):
        whitened[i, i] += 1
    values, vectors = np.linalg.eigh(whitened)
    half = product(root, vectors)
    for i in range(8):
        for j in range(8):
            half[i, j] *= np.sqrt(max(values[j] - chance, least))
    return own, product(half, transposed(half))


@compiled
def quadratic(first: NDArray[np.float32], second: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the (8, 8) weighted sums over pixels of what two parameters do to them, from (2, H, W) derivatives."""
    sums = np.empty((3, 5, 5))
    products(first, second, weight, sums)
    height, width = weight.shape
    scale = (max(height, width) / 2) ** 2
    found = np.empty((8, 8))
    for i in range(8):
        for j in range(8):
            found[i, j] = scale * dot(PRODUCTS[8 * i + j], sums.reshape(-1))
    return found


@compiled
def expected_px(hessian: NDArray[np.float64], free: NDArray[np.int64], to_corners: NDArray[np.float64]) -> float:
    """Return the expected distance of a corner from where it should be, if noise were white; 0 if nothing is told."""
    n_free = len(free)
    normal, root, moves = np.empty((n_free, n_free)), np.zeros((n_free, n_free)), np.empty((n_free, 8))
    for i in range(n_free):
        for j in range(n_free):
            normal[i, j] = hessian[free[i], free[j]]
        for row in range(8):
            moves[i, row] = to_corners[row, i]
    if not cholesky(normal, root):
        return 0.0
    # The trace of J (R R^T)^-1 J^T is the sum of the squares of R^-1 J^T.
    solve_lower(root, moves)
    total = 0.0
    for i in range(n_free):
        for row in range(8):
            total += moves[i, row] ** 2
    return float(np.sqrt(total / 4))


@compiled
def told(
    moving: Layer,
    buffers: Buffers,
    homography: NDArray[np.float64],
    pixels: int,
    weights: float,
    noise_ratio: float,
    prior: NDArray[np.float64],
    generators: NDArray[np.float64],
    to_corners: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Return what is known of a homography once images are aligned.

    Args:
        moving: the template.
        buffers: as `look` left them; they are overwritten.
        homography: (3, 3), pixels of the template to pixels of the fixed image.
        pixels: how many pixels both see.
        weights: the sum of their weights.
        noise_ratio: mean square of their difference over that which photon noise makes.
        prior: (8, 8) inverse covariance of what was known before.
        generators: (8, 3, 3), see `photonpano.geometry.generators`.
        to_corners: (8, 8) how small changes move the corners of the template, in px.

    Returns:
        The (8, 8) inverse covariance of p1..p8 of the homography, and how far a corner is expected to be from where it should,
        in px of the layer: infinite where the photons tell nothing.
    """
    _, hessian = curvatures(moving, buffers, _BY_CHANCE * by_chance(pixels, moving.blur_px), _UNKNOWN)
    # The blur correlates the noise of neighbours, so that the step scatters by H^-1 M H^-1 and not by H^-1. Weight and
    # place hardly change within the blur, so that it is enough to blur the gradients.
    share = np.float32(pixels / weights)
    for y in range(buffers.weight.shape[0]):
        row = buffers.weight[y]
        for t in range(len(row)):
            row[t] *= row[t] * share
    scatter, root = quadratic(moving.smoothed, moving.smoothed, buffers.weight), np.zeros((8, 8))
    if not cholesky(scatter, root):
        return prior, np.inf
    solve_lower(root, hessian)
    information = product(transposed(hessian), hessian)
    for i in range(8):
        for j in range(8):
            information[i, j] = information[i, j] / max(1.0, noise_ratio) + prior[i, j]
    std_px = expected_px(information, np.arange(8), to_corners)
    # From the change of the template's own frame to that of p1..p8 of the homography, with h33 kept at 1.
    to_parameters = np.empty((8, 8))
    for k in range(8):
        changed = product(homography, generators[k])
        for i in range(8):
            row_i, column_i = (i % 2, i // 2) if i < 6 else (2, i - 6)
            to_parameters[i, k] = changed[row_i, column_i] - homography[row_i, column_i] * changed[2, 2]
    to_change = np.linalg.inv(to_parameters).astype(np.float64)
    return product(transposed(to_change), product(information, to_change)), std_px if std_px > 0 else np.inf
