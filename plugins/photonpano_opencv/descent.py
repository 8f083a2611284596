"""Inverse-compositional Gauss-Newton steps on homographies (Baker and Matthews 2004), from moments of two images.

A parameter changes a pixel by its derivative times a polynomial of its place of degree two at most. So sums over all pixels are
moments of a few products, and no image for each parameter is ever made. Parameters are those of coordinates that run from -1 to
1 along the longer side.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.compiling import compiled
from photonpano.geometry.shapes import fault
from photonpano_opencv.algebra import (
    applied,
    cholesky,
    dot,
    inverse_homography,
    product,
    scaled_to_one,
    solve,
    solve_lower,
    transposed,
)
from photonpano_opencv.moments import differentiate, look, products

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano_opencv.moments import Buffers
    from photonpano_opencv.pyramid import Layer

SETTLED, LOST, UNSETTLED, DIVERGED = 0, 1, 2, 3
"""How a descent ends: at a minimum, where the images have nothing in common, not at all, or where no camera gets to."""
_BOLDEST = 5.0
"""The curvature common to both images is taken to be at least so many times what noise alone leaves in common by chance, which
is the template's over the root of the number of independent pixels; so steps stay bounded."""
_DAMPING = 0.1
"""Where a step leads astray, the next is shortened by this share of the template's curvature, and by more if that does too."""
_NEGLIGIBLE = 0.02
"""Steps of this share of what photons leave open do not count: where they tell little, steps stay small for long."""
_RENEWED_PX = 0.25
"""The curvature is taken anew until steps are smaller than this."""


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


_ALONG_X, _ALONG_Y, _PRODUCTS = _X.reshape(8, 9), _Y.reshape(8, 9), _products()


@compiled
def descend(
    moving: Layer,
    fixed: Layer,
    homography: NDArray[np.float64],
    start: NDArray[np.float64],
    prior: NDArray[np.float64],
    unit: NDArray[np.float64],
    free: NDArray[np.int64],
    to_corners: NDArray[np.float64],
    tolerance_px: float,
    max_steps: int,
    buffers: Buffers,
) -> tuple[int, NDArray[np.float64], int, float, float]:
    """Align a template to an image.

    Args:
        moving: the template.
        fixed: the other image, of the same shape.
        homography: (3, 3) where to begin, pixels of the template to pixels of the fixed image.
        start: (3, 3) what is thought of the homography before the photons are asked.
        prior: (8, 8) inverse covariance of that thought.
        unit: (3, 3), pixels to the coordinates of the parameters.
        free: which of the eight parameters may change.
        to_corners: (8, len(free)) how they move the corners of the template, in px.
        tolerance_px: the last step is followed by one that would move no corner further, or by no more than what counts.
        max_steps: how many there are at most.
        buffers: what `look` leaves in them is that of the place where the last step began.

    Returns:
        How it ended, the homography there, and what `look` told where the last step began.
    """
    height, width = moving.image.shape
    half = max(height, width) / 2
    from_unit, to_start = inverse_homography(unit), product(unit, inverse_homography(start))
    along_x, along_y = np.empty((3, 3)), np.empty((3, 3))
    own, hessian = np.zeros((8, 8)), np.zeros((8, 8))
    n_free = len(free)
    normal, towards = np.empty((n_free, n_free)), np.empty((n_free, 1))
    std_px, known = 0.0, False
    damping, before, least, last_px = 0.0, homography, np.inf, 0.0
    pixels, squares, weights = 0, 0.0, 0.0
    for _ in range(max_steps):
        pixels, squares, weights = look(moving, fixed, homography, buffers, along_x, along_y)
        if pixels == 0:
            return LOST, homography, pixels, squares, weights
        if not known:
            least_share = min(0.5, _BOLDEST * by_chance(pixels, moving.blur_px))
            own, hessian = curvatures(moving, buffers, 0.0, least_share)
            for i in range(8):
                for j in range(8):
                    hessian[i, j] += prior[i, j]
            std_px, known = _expected_px(hessian, free, to_corners), True
        moved = _changes(product(product(to_start, homography), from_unit))
        pull = applied(prior, moved)
        differs = (squares + dot(moved, pull)) / pixels
        for i in range(n_free):
            k = free[i]
            along = dot(_ALONG_X[k], along_x.reshape(-1)) + dot(_ALONG_Y[k], along_y.reshape(-1))
            towards[i, 0] = half * along + pull[k]
            for j in range(n_free):
                normal[i, j] = hessian[free[i], free[j]] + damping * own[free[i], free[j]]
        if not solve(normal, towards):
            return LOST, homography, pixels, squares, weights
        p = np.zeros(8)
        for i in range(n_free):
            p[free[i]] = towards[i, 0]
        step = product(product(from_unit, _changed(p)), unit)
        size_px = _size_px(step, height, width)
        if size_px > _RENEWED_PX:
            known = False
        if differs > least:
            # The last step led astray; a shorter one from the same place will not.
            homography, least, last_px, damping = before, np.inf, 0.0, max(_DAMPING, 4 * damping)
            continue
        before, least, damping = homography, differs, damping / 2
        homography = scaled_to_one(product(homography, inverse_homography(step)))
        # A descent that leaves what a camera can do may come back to it, but not to the truth.
        if fault(homography, height, width)[0]:
            return DIVERGED, homography, pixels, squares, weights
        # Steps shrink by about the same share each time: the next one is told from this one and the last.
        if size_px * (min(1.0, size_px / last_px) if last_px > 0 else 1.0) < max(tolerance_px, _NEGLIGIBLE * std_px):
            return SETTLED, homography, pixels, squares, weights
        last_px = size_px
    return UNSETTLED, homography, pixels, squares, weights


@compiled
def _changes(homography: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return p1..p8 of a homography."""
    p = np.empty(8)
    for i in range(8):
        # The matrix column by column: [[1 + p1, p3, p5], [p2, 1 + p4, p6], [p7, p8, 1]].
        row, column = (i % 2, i // 2) if i < 6 else (2, i - 6)
        p[i] = homography[row, column] / homography[2, 2] - (1.0 if row == column else 0.0)
    return p


@compiled
def _changed(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the homography of p1..p8."""
    homography = np.eye(3)
    for i in range(8):
        row, column = (i % 2, i // 2) if i < 6 else (2, i - 6)
        homography[row, column] += p[i]
    return homography


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
            found[i, j] = scale * dot(_PRODUCTS[8 * i + j], sums.reshape(-1))
    return found


@compiled
def _expected_px(hessian: NDArray[np.float64], free: NDArray[np.int64], to_corners: NDArray[np.float64]) -> float:
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
def _size_px(step: NDArray[np.float64], height: int, width: int) -> float:
    """Return how far a step moves the corners of an image at most."""
    largest = 0.0
    for x in (0.0, width - 1.0):
        for y in (0.0, height - 1.0):
            depth = step[2, 0] * x + step[2, 1] * y + step[2, 2]
            u = (step[0, 0] * x + step[0, 1] * y + step[0, 2]) / depth - x
            v = (step[1, 0] * x + step[1, 1] * y + step[1, 2]) / depth - y
            moved = np.sqrt(u * u + v * v) if depth > 0 else np.inf
            if not moved <= largest:
                largest = moved
    return largest
