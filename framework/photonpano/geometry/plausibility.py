"""Plausibility of pairwise motions: reasons to reject a homography between two images of one camera."""

from __future__ import annotations

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
    import cv2

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
    frame = corners(shape).astype(np.float32)
    # OpenCV loses parts of polygons whose corners lie closer together than this.
    covered, _ = cv2.intersectConvexConvex(transform_points(homography, frame).round(1).astype(np.float32), frame)
    overlap = covered / ((shape[0] - 1) * (shape[1] - 1))
    if overlap < min_overlap:
        return f"the images overlap by {overlap:.0%} (at least {min_overlap:.0%} is needed)"
    return None
