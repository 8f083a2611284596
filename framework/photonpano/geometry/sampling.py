"""Rows of pixels seen through a homography: which of them see an image, and which see it next to each other.

Where an image is hardly turned, neighbours on a row see neighbours. Along such a run its pixels are read in the order in which
they lie in memory, and interpolation can be vectorised.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from photonpano.compiling import compiled

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Pixels: TypeAlias = NDArray[np.float32] | NDArray[np.uint32]

_LONGEST_RUN = 256
"""So that small numbers stay exact enough in float32."""


class _Run(NamedTuple):
    """Pixels of a row, t = 0, 1, ..., that see `left + t` and its neighbour, in the image's rows `top` and `top + 1`.

    Pixel t looks further right by `(a0 + a1 t + a2 t^2) / (1 + slope t)`, and further down by `(b0 + b1 t) / (1 + slope t)`;
    both are fractions, from 0 to 1.
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
def seen_part(
    to_image: NDArray[np.float64], y: int, left: float, right: float, top: float, bottom: float, width: int
) -> tuple[int, int]:
    """Return the pixels of a row, half-open, that see a rectangle of the image, border included."""
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
def sample_run(image: Pixels, to_image: NDArray[np.float64], x: int, y: int, into: NDArray[np.float32]) -> int:
    """Interpolate an image linearly at the pixels of a row from x on, as long as they see it next to each other.

    Args:
        image: (h, w) float32 or uint32.
        to_image: (3, 3), pixels of the grid to pixels of the image.
        x: the first pixel, which must see the image, border included, as all must that `into` has room for.
        y: its row.
        into: becomes what they see.

    Returns:
        How many they are.
    """
    height, width = image.shape
    run = _run_from(to_image, x, y, len(into), height, width)
    pixels = image.reshape(-1)
    # An index without a sign needs no look at whether it counts from the end.
    above, one = np.uint64(run.top * width + run.left), np.uint64(1)
    below = above + np.uint64(width)
    a0, a1, a2, b0, b1, slope = run.a0, run.a1, run.a2, run.b0, run.b1, run.slope
    for t in range(run.size):
        t_px = np.float32(t)
        scale = np.float32(1) / (np.float32(1) + slope * t_px)
        a, b = (a0 + t_px * (a1 + t_px * a2)) * scale, (b0 + t_px * b1) * scale
        i, j = above + np.uint64(t), below + np.uint64(t)
        p, q = np.float32(pixels[i]), np.float32(pixels[j])
        upper, lower = p + a * (np.float32(pixels[i + one]) - p), q + a * (np.float32(pixels[j + one]) - q)
        into[t] = upper + b * (lower - upper)
    return run.size


@compiled
def _run_from(to_image: NDArray[np.float64], x: int, y: int, most: int, height: int, width: int) -> _Run:
    """Return the run of pixels that starts at (x, y).

    Args:
        to_image: (3, 3), pixels of the grid to pixels of the image.
        x: the first pixel, which must see the image, border included.
        y: its row.
        most: how many pixels the row has from there.
        height: rows of the image.
        width: columns of the image.
    """
    depth = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2]
    u = (to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2]) / depth
    v = (to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2]) / depth
    slope = to_image[2, 0] / depth
    left, top = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - left, v - top
    a1, a2 = to_image[0, 0] / depth - u * slope - 1 + a * slope, -slope
    b1 = to_image[1, 0] / depth - v * slope + b * slope
    # How far both fractions stay between 0 and 1.
    ahead = min(float(min(most, _LONGEST_RUN, width - 1 - left)), _positive_until(a, a1, a2))
    ahead = min(ahead, _positive_until(1 - a, slope - a1, -a2))
    ahead = min(ahead, _positive_until(b, b1, 0.0))
    ahead = min(ahead, _positive_until(1 - b, slope - b1, 0.0))
    return _Run(
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
def _positive_until(constant: float, linear: float, square: float) -> float:
    """Return where a polynomial that is positive at 0 first becomes negative."""
    if linear >= 0 and square >= 0:
        return float(_LONGEST_RUN)
    root = np.sqrt(max(0.0, linear * linear - 4 * square * constant))
    if square < 0:
        return float((linear + root) / (-2 * square))
    if linear * linear < 4 * square * constant:
        return float(_LONGEST_RUN)
    # Written so that it holds for a square of 0, too.
    return float(2 * constant / (root - linear))
