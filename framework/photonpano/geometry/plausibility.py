"""Plausibility of pairwise motions: reasons to reject a homography between two images of one camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photonpano.geometry.homographies import corners, transform_points
from photonpano.values import Homography


def why_implausible(homography: Homography, shape: tuple[int, int], min_overlap: float = 0.1) -> str | None:
    """Return why a map between two images of one camera is implausible; None if it is plausible.

    Args:
        homography: (3, 3), pixels of the moving image to pixels of the fixed one.
        shape: (height, width) of both images.
        min_overlap: share of the fixed image that the moving one must cover at least.
    """
    from photonpano.geometry import shapes  # compiled

    homography = np.ascontiguousarray(homography, dtype=np.float64)
    kind, number = shapes.violation(homography, *shape)
    if kind != shapes.PLAUSIBLE:
        return {
            shapes.INFINITE: "the homography is not finite",
            shapes.BEHIND: "the homography sends part of the image behind the camera",
            shapes.FOLDED: "the homography mirrors or folds the image",
            shapes.AREA: f"the homography changes the area of the image by a factor of {number:.2g} "
            f"(at most {shapes.MAX_AREA_CHANGE:g} is plausible)",
            shapes.SIDES: f"the homography makes opposite sides of the image differ by a factor of {number:.2g} "
            f"(at most {shapes.MAX_SIDE_CHANGE:g} is plausible)",
        }[kind]
    quad = transform_points(homography, corners(shape)).tolist()
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
