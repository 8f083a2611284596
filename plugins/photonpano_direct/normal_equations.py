"""Residuals, gradient, Hessian and information matrix of an alignment, from moments of image derivatives.

The derivative of a pixel with respect to a parameter of the homography is a derivative of the image times a polynomial in x
and y of degree two at most. So all sums over pixels are moments of a few products, and no image per parameter is computed.
Parameters are p1..p8 in unit coordinates, which are 0 in the centre of the image and run from -1 to 1 along the longer side.

Loops over pixels and small matrices are compiled: numba compiles such loops ten times as fast as calls of numpy.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, Homography
from photonpano.compiling import compiled
from photonpano.geometry import run_from, sample_run, visible_columns
from photonpano.locating import MIN_COMMON_CURVATURE, PRIOR_STD, noise_of


@compiled
def product(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the product of (n, k) and (k, m) matrices."""
    result = np.zeros((first.shape[0], second.shape[1]))
    for i in range(first.shape[0]):
        for k in range(first.shape[1]):
            for j in range(second.shape[1]):
                result[i, j] += first[i, k] * second[k, j]
    return result


@compiled
def dot(first: FloatArray, second: FloatArray) -> float:
    """Return the scalar product of two (k,) vectors."""
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


@compiled
def transposed(matrix: FloatArray) -> FloatArray:
    """Return the transpose of a matrix as a C-contiguous copy."""
    result = np.empty((matrix.shape[1], matrix.shape[0]))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            result[j, i] = matrix[i, j]
    return result


@compiled
def applied(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the product of an (n, k) matrix and a (k,) vector."""
    result = np.empty(matrix.shape[0])
    for i in range(matrix.shape[0]):
        result[i] = dot(matrix[i], vector)
    return result


@compiled
def inverse_homography(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a (3, 3) matrix, up to scale: its adjugate."""
    result = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            result[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    return result


@compiled
def scaled_to_one(homography: FloatArray) -> FloatArray:
    """Return a homography with h33 = 1."""
    result = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            result[i, j] = homography[i, j] / homography[2, 2]
    return result


@compiled
def _cholesky(matrix: FloatArray, root: FloatArray) -> bool:
    """Write the lower Cholesky factor into `root`, which holds zeros; return whether the matrix is positive definite."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = left / root[j, j]
            elif left > 0:
                root[i, i] = np.sqrt(left)
            else:
                return False
    return True


@compiled
def _solve_lower(root: FloatArray, right: FloatArray) -> None:
    """Solve R x = right in place, for a lower triangular R and (n, m) right sides."""
    for i in range(len(root)):
        for j in range(right.shape[1]):
            left = right[i, j]
            for k in range(i):
                left -= root[i, k] * right[k, j]
            right[i, j] = left / root[i, i]


@compiled
def solve(matrix: FloatArray, right: FloatArray) -> bool:
    """Solve linear equations with an (n, 1) right side in place; return whether the matrix is positive definite."""
    n = len(right)
    root = np.zeros((n, n))
    if not _cholesky(matrix, root):
        return False
    _solve_lower(root, right)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i, 0] -= root[k, i] * right[k, 0]
        right[i, 0] /= root[i, i]
    return True


Image = NDArray[np.float32]


class Layer(NamedTuple):
    """A level of an image pyramid."""

    image: Image  # (H, W), variance-stabilised and blurred
    weight: Image  # (H, W), inverse noise variance of a pixel before the blur; 0 at masked pixels
    # standard deviation of the Gaussian that reduces white noise as much as the blur and the halving did, in px of the layer
    blur_px: float
    gradients: Image  # (2, H, W), derivatives of the image along x and y
    smoothed: Image  # (2, H, W), the gradients, blurred by the same Gaussian once more


class Buffers(NamedTuple):
    """Images that a thread reuses, since to allocate them takes longer than to fill them."""

    residual: Image  # (H, W)
    weight: Image  # (H, W)
    gradients: Image  # (2, H, W)


@compiled
def residuals_and_moments(  # noqa: PLR0917
    moving: Layer, fixed: Layer, homography: Homography, buffers: Buffers, moments_x: FloatArray, moments_y: FloatArray
) -> tuple[int, float, float]:
    """Compute the residuals of a template, their weights, and the moments of the weighted residuals times derivatives.

    Moments are in unit coordinates: x and y are 0 in the centre, and run from -1 to 1 along the longer side.

    Args:
        moving: the template.
        fixed: the other image, of the same shape.
        homography: (3, 3), pixels of the template to pixels of the fixed image.
        buffers: output: `residual` is the warped fixed image minus the template, `weight` the inverse variance of the residual,
            0 where either is masked.
        moments_x: (3, 3) output: sums of residual times weight times derivative along x times x^i y^j.
        moments_y: (3, 3) output: the same for the derivative along y.

    Returns:
        The number of pixels that both see, the weighted sum of the squared residuals, and the sum of the weights.
    """
    height, width = moving.image.shape
    half = max(height, width) / 2
    moments_x[:] = 0
    moments_y[:] = 0
    seen, squares, weights = 0.0, 0.0, 0.0
    across, zero, one = _across(width, half), np.float32(0), np.float32(1)
    for y in range(height):
        _compare(moving, fixed, homography, y, buffers)
        residual, weight = buffers.residual[y], buffers.weight[y]
        gx, gy = moving.gradients[0][y], moving.gradients[1][y]
        x0, x1, x2, y0, y1, square, count, total = zero, zero, zero, zero, zero, zero, zero, zero
        for t in range(width):
            x, r, w = across[t], residual[t], weight[t]
            wr = w * r
            by_x, by_y = wr * gx[t], wr * gy[t]
            x0 += by_x
            x1 += by_x * x
            x2 += by_x * x * x
            y0 += by_y
            y1 += by_y * x
            square += wr * r
            count += one if w > zero else zero
            total += w
        squares += float(square)
        seen += float(count)
        weights += float(total)
        y_unit = (y - (height - 1) / 2) / half
        power = 1.0
        for j in range(3):
            if j < 2:
                moments_x[0, j] += x0 * power
                moments_x[1, j] += x1 * power
                moments_x[2, j] += x2 * power
            moments_y[0, j] += y0 * power
            moments_y[1, j] += y1 * power
            power *= y_unit
    return int(seen), squares, weights


@compiled
def _compare(moving: Layer, fixed: Layer, homography: Homography, y: int, buffers: Buffers) -> None:
    """Compute residual and weight of row y; see `residuals_and_moments`."""
    height, width = fixed.image.shape
    image, weight, residual, combined = moving.image[y], moving.weight[y], buffers.residual[y], buffers.weight[y]
    zero, tiny = np.float32(0), np.float32(1e-20)
    first, last = visible_columns(homography, y, 0.0, width - 1.0, 0.0, height - 1.0, width)
    for x in range(first):
        residual[x], combined[x] = zero, zero
    for x in range(last, width):
        residual[x], combined[x] = zero, zero
    x = first
    while x < last:
        run = run_from(homography, x, y, last - x, height, width)
        sample_run(fixed.image, run, residual[x : x + run.size])
        # Weights are interpolated too: with nearest neighbours they would jump at borders.
        sample_run(fixed.weight, run, combined[x : x + run.size])
        x += run.size
    # One loop for each output, since only such loops are vectorised.
    image, weight, residual, combined = image[first:last], weight[first:last], residual[first:last], combined[first:last]
    for t in range(len(image)):
        residual[t] -= image[t]
    for t in range(len(image)):
        combined[t] *= weight[t] / max(weight[t] + combined[t], tiny)


@compiled
def _across(width: int, half: float) -> Image:
    """Return the unit coordinates of the pixels of a row: (width,). To read them is faster than to compute them in loops."""
    across = np.empty(width, np.float32)
    for x in range(width):
        across[x] = (x - (width - 1) / 2) / half
    return across


@compiled
def derivative_moments(first: Image, second: Image, weight: Image, moments: FloatArray) -> None:
    """Compute (3, 5, 5) weighted sums of the products xx, xy and yy of (2, H, W) derivatives of two images times x^i y^j."""
    height, width = weight.shape
    half = max(height, width) / 2
    across, zero = _across(width, half), np.float32(0)
    moments[:] = 0
    for y in range(height):
        px, py, qx, qy, w = first[0][y], first[1][y], second[0][y], second[1][y], weight[y]
        xx0, xx1, xx2, xx3, xx4 = zero, zero, zero, zero, zero
        xy0, xy1, xy2, xy3 = zero, zero, zero, zero
        yy0, yy1, yy2 = zero, zero, zero
        for t in range(width):
            x = across[t]
            x2 = x * x
            wx, wy = w[t] * px[t], w[t] * py[t]
            xx, yy, xy = wx * qx[t], wy * qy[t], np.float32(0.5) * (wx * qy[t] + wy * qx[t])
            xx0 += xx
            xx1 += xx * x
            xx2 += xx * x2
            xx3 += xx * x2 * x
            xx4 += xx * x2 * x2
            xy0 += xy
            xy1 += xy * x
            xy2 += xy * x2
            xy3 += xy * x2 * x
            yy0 += yy
            yy1 += yy * x
            yy2 += yy * x2
        y_unit = (y - (height - 1) / 2) / half
        power = 1.0
        for j in range(5):
            if j < 3:
                moments[0, 0, j] += xx0 * power
                moments[0, 1, j] += xx1 * power
                moments[0, 2, j] += xx2 * power
                moments[0, 3, j] += xx3 * power
                moments[0, 4, j] += xx4 * power
            if j < 4:
                moments[1, 0, j] += xy0 * power
                moments[1, 1, j] += xy1 * power
                moments[1, 2, j] += xy2 * power
                moments[1, 3, j] += xy3 * power
            moments[2, 0, j] += yy0 * power
            moments[2, 1, j] += yy1 * power
            moments[2, 2, j] += yy2 * power
            power *= y_unit


@compiled
def differentiate(image: Image, gradients: Image) -> None:
    """Write the central differences of (H, W) pixels along x and y: (2, H, W); 0 at the borders."""
    height, width = image.shape
    half = np.float32(0.5)
    for y in range(height):
        along_x, along_y, here = gradients[0][y], gradients[1][y], image[y]
        inner, right = along_x[1 : width - 1], here[2:]
        along_x[0], along_x[width - 1] = np.float32(0), np.float32(0)
        for t in range(len(inner)):
            inner[t] = half * (right[t] - here[t])
        if 0 < y < height - 1:
            above, below = image[y - 1], image[y + 1]
            for t in range(width):
                along_y[t] = half * (below[t] - above[t])
        else:
            for t in range(width):
                along_y[t] = np.float32(0)


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
def curvatures(moving: Layer, buffers: Buffers, chance: float, floor: float) -> tuple[FloatArray, FloatArray, float]:
    """Return the (8, 8) Gauss-Newton Hessian of the template, the part that both images have in common, and its mean share.

    The noise of the template has derivatives too, larger in the dark than those of the scene. The two images have only the
    scene in common. The common curvature of noise by `chance` is subtracted, and eigenvalues stay above `floor`, both relative
    to the template's. The gradients of the buffers are overwritten.
    """
    own = _hessian(moving.gradients, moving.gradients, buffers.weight)
    differentiate(buffers.residual, buffers.gradients)
    difference = _hessian(moving.gradients, buffers.gradients, buffers.weight)
    # Whitened by the template's Hessian, so that all parameters have the same scale.
    root = np.zeros((8, 8))
    if not _cholesky(own, root):
        return own, own.copy(), 1.0
    _solve_lower(root, difference)
    whitened = transposed(difference)
    _solve_lower(root, whitened)
    for i in range(8):
        whitened[i, i] += 1
    values, vectors = np.linalg.eigh(whitened)
    half = product(root, transposed(vectors.T))  # in C order, for which `product` is compiled
    common = 0.0
    for j in range(8):
        share = max(values[j] - chance, floor)
        common += share / 8
        for i in range(8):
            half[i, j] *= np.sqrt(share)
    return own, product(half, transposed(half)), common


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
    if not _cholesky(product(of_basis, product(information, basis)), root):
        return 0.0
    # The trace of J (R R^T)^-1 J^T is the sum of the squares of R^-1 J^T.
    _solve_lower(root, moves)
    squares = 0.0
    for i in range(moves.shape[0]):
        squares += dot(moves[i], moves[i])
    return float(np.sqrt(squares / 4))


_AROUND = 2.0  # standard deviation of the Gaussian within which residuals are averaged, in that of the blur


def local_noise(residual: Image, weight: Image, blur_px: float) -> Image:
    """Return the mean squared residual around each pixel, over that of all that both images see, weighted: (H, W).

    In the dark, pixels hold less than a photon, and no scale makes noise uniform: a star is noisier than the sky around it.
    """
    seen = np.asarray(weight > 0, np.float32)
    squares = seen * np.square(residual)
    usual = np.vdot(weight, squares) / max(seen.sum(), 1)
    # What is as smooth as this is averaged on every other pixel.
    height, width = weight.shape
    around, share = (
        cv2.GaussianBlur(cv2.resize(each, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), (0, 0), _AROUND * blur_px / 2)
        for each in (squares, seen)
    )
    noise = np.asarray(around / np.maximum(share * usual, np.float32(1e-20)), np.float32)
    return np.asarray(cv2.resize(noise, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def information_of(
    moving: Layer,
    buffers: Buffers,
    homography: Homography,
    *,
    noise_ratio: float,
    coordinates: Coordinates,
) -> tuple[FloatArray, float, float]:
    """Return the inverse covariance of p1..p8, (8, 8), and the expected error of a corner in px, infinite without texture.

    The third result is the share of the template's curvature that both images have in common. Residual and weight of the
    buffers come from `residuals_and_moments`, and all are overwritten. `noise_ratio` is the mean squared residual relative to
    that of photon noise.
    """
    pixels, noise = int(np.count_nonzero(buffers.weight)), local_noise(buffers.residual, buffers.weight, moving.blur_px)
    _, hessian, common = curvatures(moving, buffers, chance_level(pixels, moving.blur_px), MIN_COMMON_CURVATURE)
    # The blur correlates the noise of neighbours, so the step scatters by H^-1 M H^-1 and not by H^-1. Weights, noise and
    # positions hardly change within the blur, so M needs only blurred gradients.
    np.multiply(buffers.weight, buffers.weight, out=buffers.weight)
    np.multiply(buffers.weight, noise, out=buffers.weight)
    scatter, root = _hessian(moving.smoothed, moving.smoothed, buffers.weight), np.zeros((8, 8))
    if not _cholesky(scatter, root):
        return PRIOR.copy(), np.inf, 0.0
    _solve_lower(root, hessian)
    information = hessian.T @ hessian / noise_of(noise_ratio) + PRIOR
    std_px = expected_px(information, np.eye(8), coordinates.to_corners)
    # From steps in unit coordinates of the template to p1..p8 of the homography, with h33 = 1.
    changed = homography @ coordinates.generators
    to_parameters = (changed - homography * changed[:, 2:, 2:])[:, _ROWS, _COLUMNS].T
    to_step = np.linalg.inv(to_parameters)
    return to_step.T @ information @ to_step, std_px if std_px > 0 else np.inf, common
