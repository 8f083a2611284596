"""Compare motions: reasons to reject one between two images of a camera, and the map between the planes of two trajectories."""

from __future__ import annotations

import numpy as np

from photonpano.geometry.camera import nearest_rotations
from photonpano.geometry.homographies import corners, from_parameters, normalised, transform_points, unit_coordinates
from photonpano.values import FloatArray, Homography


def why_implausible(homography: Homography, shape: tuple[int, int], min_overlap: float = 0.1) -> str | None:
    """Return why a map between two images of one camera is implausible; None if it is plausible.

    It maps pixels of the moving image to those of the fixed one, both of (height, width), of which the moving one must cover at
    least the share `min_overlap`.
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


# Evenly spaced frames to which the alignment is fitted. They are plenty: a homography has eight parameters, and each frame
# gives eight equations.
_FIT_FRAMES = 300

_FAR_PX = 1e6  # residual of points mapped to infinity


def align_planes(
    estimated: FloatArray, true: FloatArray, frame_shape: tuple[int, int], start: Homography | None = None
) -> Homography:
    """Return the map G from the estimated reference plane to the true plane that fits both trajectories best.

    A trajectory is determined up to the choice of its reference plane. G minimises the sum over frames t and corners c of

        | inv(true_t) G estimated_t c - c |^2

    in pixels of the frame, so that the result does not depend on the plane in which either trajectory is given.

    Convention:
        Homographies map pixels of a frame to pixels of a plane; points are (x, y), integers are pixel centres.

    Args:
        estimated: (T, 3, 3), frame pixels to pixels of the estimated reference plane.
        true: (T, 3, 3), frame pixels to pixels of the true plane.
        frame_shape: (height, width) of a frame.
        start: (3, 3) near the result; needed where a camera turns too far for one plane, and G has another h33 there.

    Returns:
        (3, 3), pixels of the estimated reference plane to pixels of the true plane; h33 = 1 without a start.

    Raises:
        ValueError: the trajectories are empty, or differ in length.
    """
    import cv2
    from scipy.optimize import least_squares

    if len(estimated) != len(true) or not len(true):
        raise ValueError(
            f"only trajectories of the same length can be aligned, got {len(estimated)} and {len(true)} homographies"
        )
    chosen = np.unique(np.linspace(0, len(true) - 1, _FIT_FRAMES).round().astype(int))
    frame, condition = corners(frame_shape), unit_coordinates(frame_shape)
    to_plane, to_frame = estimated[chosen], np.linalg.inv(true[chosen])
    first = start
    if first is None:
        here, there = (transform_points(each, frame).reshape(-1, 2) for each in (to_plane, true[chosen]))
        first = np.asarray(cv2.findHomography(here, there)[0], np.float64)  # the direct linear transform (Hartley 1997)
    left = first @ np.linalg.inv(condition)

    def plane(p: FloatArray) -> Homography:
        # Steps from the start, in coordinates in which all eight parameters have about the same scale.
        return left @ from_parameters(p) @ condition

    def residuals(p: FloatArray) -> FloatArray:
        # Points of the plane may lie behind the camera, or at infinity.
        residual = transform_points(to_frame @ plane(p) @ to_plane, frame) - frame
        return np.nan_to_num(residual, nan=_FAR_PX, posinf=_FAR_PX, neginf=-_FAR_PX).ravel()

    fit = least_squares(residuals, np.zeros(8), method="lm", x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return normalised(plane(fit.x)) if start is None else plane(fit.x)


def align_rotations(estimated: FloatArray, true: FloatArray) -> FloatArray:
    """Return the rotation G that brings G estimated_t nearest to true_t: (3, 3), for (T, 3, 3) rotations (Kabsch 1976)."""
    return nearest_rotations((true @ np.swapaxes(estimated, -1, -2)).mean(axis=0))
