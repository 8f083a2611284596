"""Inverse-compositional Gauss-Newton steps on homographies (Baker and Matthews 2004)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.geometry import violation
from photonpano_direct.curvature import ALONG_X, ALONG_Y, by_chance, curvatures, expected_px
from photonpano_direct.layers import Layer
from photonpano_direct.moments import Buffers, look
from photonpano_direct.small_matrices import applied, dot, inverse_homography, product, scaled_to_one, solve

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
            std_px, known = expected_px(hessian, free, to_corners), True
        moved = _changes(product(product(to_start, homography), from_unit))
        pull = applied(prior, moved)
        differs = (squares + dot(moved, pull)) / pixels
        for i in range(n_free):
            k = free[i]
            along = dot(ALONG_X[k], along_x.reshape(-1)) + dot(ALONG_Y[k], along_y.reshape(-1))
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
        if violation(homography, height, width)[0]:
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
