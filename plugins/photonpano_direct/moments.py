"""Residuals and moments of two images: all sums over pixels that a step of their alignment needs, in one pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, Homography
from photonpano.compiling import compiled
from photonpano.geometry import run_from, sample_run, visible_columns

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
def residuals_and_moments(
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
