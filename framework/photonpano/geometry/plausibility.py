"""Which pairwise motions a camera can make: what is refused, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry.homographies import apply, corners

if TYPE_CHECKING:
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
    if not np.all(np.isfinite(homography)):
        return "the homography is not finite"
    frame = corners(shape)
    depth = frame @ homography[2, :2] + homography[2, 2]
    if depth.min() <= 0:
        return "the homography sends part of the image behind the camera"
    quad = apply(homography, frame)
    edges = np.roll(quad, -1, axis=0) - quad
    turns = edges[:, 0] * np.roll(edges[:, 1], -1) - edges[:, 1] * np.roll(edges[:, 0], -1)
    if turns.min() <= 0:
        return "the homography mirrors or folds the image"
    area = _area(quad) / _area(frame)
    if not 1 / MAX_AREA_CHANGE < area < MAX_AREA_CHANGE:
        return f"the homography changes the area of the image {area:.2g} times (at most {MAX_AREA_CHANGE:g} is plausible)"
    sides = np.linalg.norm(edges, axis=1)
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


def _area(polygon: np.ndarray) -> float:
    x, y = polygon.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)


def _overlap(quad: np.ndarray, shape: tuple[int, int]) -> float:
    """Return the share of the image that a convex quadrangle covers (Sutherland-Hodgman clipping)."""
    polygon = quad
    height, width = shape
    for axis, sign, bound in ((0, 1, 0), (0, -1, width - 1), (1, 1, 0), (1, -1, height - 1)):
        distance = sign * (polygon[:, axis] - bound)
        clipped = []
        for here, there, d_here, d_there in zip(
            polygon, np.roll(polygon, -1, axis=0), distance, np.roll(distance, -1), strict=True
        ):
            if d_here >= 0:
                clipped.append(here)
            if (d_here >= 0) != (d_there >= 0):
                clipped.append(here + (there - here) * (d_here / (d_here - d_there)))
        if len(clipped) < 3:
            return 0.0
        polygon = np.array(clipped)
    return _area(polygon) / _area(corners(shape))
