"""Which pairwise motions a camera can make: what is refused, and why."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry.homographies import corners

if TYPE_CHECKING:
    from collections.abc import Sequence

    from photonpano.values import Homography

MAX_AREA_CHANGE = 2.0
"""Two exposures that share the field of view of one camera do not differ more than this in size."""
MAX_SIDE_CHANGE = 1.5
"""The same for the ratio of opposite sides, which perspective changes."""


def implausibility(homography: Homography, shape: tuple[int, int], min_overlap: float = 0.1) -> str | None:
    """Tell why a map between two images of one camera cannot be true; None if it can.

    Args:
        homography: (3, 3), pixels of the moving image to pixels of the fixed one.
        shape: (height, width) of both images.
        min_overlap: the least share of the fixed image that the moving one must cover.
    """
    # Four corners are too few for arrays: plain numbers take a tenth of the time.
    (a, b, c), (d, e, f), (g, h, i) = matrix = np.asarray(homography, dtype=np.float64).tolist()
    if not all(math.isfinite(number) for row in matrix for number in row):
        return "the homography is not finite"
    frame = corners(shape).tolist()
    depths = [g * x + h * y + i for x, y in frame]
    if min(depths) <= 0:
        return "the homography sends part of the image behind the camera"
    quad = [((a * x + b * y + c) / z, (d * x + e * y + f) / z) for (x, y), z in zip(frame, depths, strict=True)]
    edges = [(quad[k - 3][0] - quad[k][0], quad[k - 3][1] - quad[k][1]) for k in range(4)]
    if min(edges[k][0] * edges[k - 3][1] - edges[k][1] * edges[k - 3][0] for k in range(4)) <= 0:
        return "the homography mirrors or folds the image"
    area = _area(quad) / _area(frame)
    if not 1 / MAX_AREA_CHANGE < area < MAX_AREA_CHANGE:
        return f"the homography changes the area of the image {area:.2g} times (at most {MAX_AREA_CHANGE:g} is plausible)"
    sides = [math.hypot(*edge) for edge in edges]
    for first, second in ((0, 2), (1, 3)):
        ratio = max(sides[first], sides[second]) / min(sides[first], sides[second])
        if ratio > MAX_SIDE_CHANGE:
            return (
                f"the homography makes opposite sides of the image differ {ratio:.2g} times "
                f"(at most {MAX_SIDE_CHANGE:g} is plausible)"
            )
    overlap = _overlap(quad, shape)
    if overlap < min_overlap:
        return f"the images overlap by {overlap:.0%} (at least {min_overlap:.0%} is needed)"
    return None


def _area(polygon: Sequence[Sequence[float]]) -> float:
    following = [*polygon[1:], polygon[0]]
    return abs(sum(x * y_next - y * x_next for (x, y), (x_next, y_next) in zip(polygon, following, strict=True))) / 2


def _overlap(quad: Sequence[Sequence[float]], shape: tuple[int, int]) -> float:
    """Return the share of the image that a convex quadrangle covers (Sutherland-Hodgman clipping)."""
    polygon = quad
    height, width = shape
    for axis, sign, bound in ((0, 1, 0), (0, -1, width - 1), (1, 1, 0), (1, -1, height - 1)):
        distance = [sign * (point[axis] - bound) for point in polygon]
        clipped: list[Sequence[float]] = []
        for index, here in enumerate(polygon):
            following = (index + 1) % len(polygon)
            d_here, d_there = distance[index], distance[following]
            if d_here >= 0:
                clipped.append(here)
            if (d_here >= 0) != (d_there >= 0):
                share = d_here / (d_here - d_there)
                clipped.append([a + (b - a) * share for a, b in zip(here, polygon[following], strict=True)])
        if len(clipped) < 3:
            return 0.0
        polygon = clipped
    return _area(polygon) / _area(corners(shape).tolist())
