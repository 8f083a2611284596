"""Linear interpolation of an image along the rows of a grid that a homography maps to it. Compiled.

Where the homography hardly rotates, neighbours on a row of the grid map to neighbours in the image. Along such a run the image
is read in the order of memory, so that interpolation is vectorised.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled
from photonpano.values import Homography

Pixels: TypeAlias = NDArray[np.float32] | NDArray[np.uint32]

LONGEST_RUN = 512  # largest size of a run, so that float32 is exact enough
# Fractions of a pixel that are outside of 0 to 1 by less than this are inside: a still image lies on whole pixels.
_ROUNDING = 1e-6
# Precomputed float32 indices: an int-to-float conversion in the loop would dominate it.
_STEPS = np.arange(LONGEST_RUN, dtype=np.float32)


class Run(NamedTuple):
    """Pixels t = 0, 1, ... of a grid row that map between columns `left + t` and `left + t + 1`, rows `top` and `top + 1`.

    The fraction along x is `(a0 + a1 t + a2 t^2) / (1 + slope t)`, that along y is `(b0 + b1 t) / (1 + slope t)`; both are from
    0 to 1.
    """

    size: int
    left: int
    top: int
    a0: np.float32
    a1: np.float32
    a2: np.float32
    b0: np.float32
    b1: np.float32
    slope: np.float32


@compiled
def visible_columns(  # noqa: PLR0917
    to_image: Homography, y: int, left: float, right: float, top: float, bottom: float, width: int
) -> tuple[int, int]:
    """Return the half-open range of pixels of row y of a grid that map into a rectangle of the image, border included.

    `to_image` maps pixels of the grid, of `width` columns, to those of the image, where the rectangle reaches from x `left` to
    `right` and from y `top` to `bottom`.
    """
    depth, along = to_image[2, 1] * y + to_image[2, 2], to_image[2, 0]
    u, du = to_image[0, 1] * y + to_image[0, 2], to_image[0, 0]
    v, dv = to_image[1, 1] * y + to_image[1, 2], to_image[1, 0]
    low, high = 0.0, width - 1.0
    # left <= (u + du x) / (depth + along x) and so on are linear where the depth is positive, as it is in front of the camera.
    for at, slope in (
        (u - left * depth, du - left * along),
        (right * depth - u, right * along - du),
        (v - top * depth, dv - top * along),
        (bottom * depth - v, bottom * along - dv),
        (depth, along),
    ):
        if slope > 0:
            low = max(low, -at / slope)
        elif slope < 0:
            high = min(high, -at / slope)
        elif at < 0:
            return 0, 0
    if not low <= high:
        return 0, 0
    return int(np.ceil(low)), int(np.floor(high)) + 1


@compiled
def run_from(to_image: Homography, x: int, y: int, most: int, height: int, width: int) -> Run:  # noqa: PLR0917
    """Return the run of pixels of a grid row that starts at (x, y), of at most `most`.

    `to_image` maps pixels of the grid to those of the image, of `height` rows and `width` columns. The first pixel and the
    following ones must map into the image, border included: see `visible_columns`.
    """
    per_depth = 1 / (to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2])
    u = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) * per_depth
    v = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) * per_depth
    slope = to_image[2, 0] * per_depth
    left, top = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - left, v - top
    a1, a2 = to_image[0, 0] * per_depth - left * slope - 1, -slope
    b1 = to_image[1, 0] * per_depth - top * slope
    # The size of the run: both fractions stay between 0 and 1.
    ahead = float(min(most, LONGEST_RUN, width - 1 - left))
    ahead = _positive_until(a, a1, a2, ahead)
    ahead = _positive_until(1 - a, slope - a1, -a2, ahead)
    ahead = _positive_until(b, b1, 0.0, ahead)
    ahead = _positive_until(1 - b, slope - b1, 0.0, ahead)
    return Run(
        max(1, int(ahead)),
        left,
        top,
        np.float32(a),
        np.float32(a1),
        np.float32(a2),
        np.float32(b),
        np.float32(b1),
        np.float32(slope),
    )


@compiled
def sample_run(image: Pixels, run: Run, into: NDArray[np.float32]) -> None:
    """Interpolate an image, (h, w) float32 or uint32, linearly along a run, into (run.size,) values."""
    pixels, width = image.reshape(-1), image.shape[1]
    above, below = run.top * width + run.left, (run.top + 1) * width + run.left
    size = len(into)
    top_left, top_right = pixels[above : above + size], pixels[above + 1 : above + 1 + size]
    bottom_left, bottom_right = pixels[below : below + size], pixels[below + 1 : below + 1 + size]
    steps, one = _STEPS[:size], np.float32(1)
    a0, a1, a2, b0, b1, slope = run.a0, run.a1, run.a2, run.b0, run.b1, run.slope
    for t in range(size):
        step = steps[t]
        scale = one / (one + slope * step)
        a, b = (a0 + step * (a1 + step * a2)) * scale, (b0 + step * b1) * scale
        p, q = np.float32(top_left[t]), np.float32(bottom_left[t])
        upper, lower = p + a * (np.float32(top_right[t]) - p), q + a * (np.float32(bottom_right[t]) - q)
        into[t] = upper + b * (lower - upper)


@compiled
def _positive_until(constant: float, linear: float, square: float, most: float) -> float:
    """Return the first root of a polynomial that is positive at 0, at most `most`; below 0 by rounding errors is positive."""
    at_end = constant + most * (linear + most * square)
    # A concave polynomial has its minimum at an end, a convex one perhaps between.
    if at_end >= -_ROUNDING and (square <= 0 or linear >= 0 or linear + 2 * square * most <= 0):
        return most
    discriminant = linear * linear - 4 * square * constant
    if discriminant < 0:
        return most
    root = np.sqrt(discriminant)
    if square < 0:
        return float(min(most, (linear + root) / (-2 * square)))
    # In this form it holds for a square of 0 too.
    return float(min(most, 2 * constant / (root - linear)))
