"""From two aligned images to a motion that can be believed: the end of every locator that works with brightness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import corners, generators, jacobian, slopes, unit_coordinates, why_implausible
from photonpano.locating.configs import ImageLimits
from photonpano.locating.viewing import View
from photonpano.photometry import Similarity, autocorrelation, similarity_of
from photonpano.values import FloatArray, Homography, Located, NotLocated

ALL = (0, 1, 2, 3, 4, 5, 6, 7)
"""All of p1..p8."""
_JUDGED_PIXEL = 4
"""Images are compared in px so many times as large: noise is small there, and blur hardly counts."""
_SMALLEST_SIDE = 24
"""Images are not halved to fewer px than this."""
_SURROUNDINGS_PX = 13
"""What counts as the surroundings of a pixel when images are compared: a square of this side."""
_UNKNOWN = 1e-3
"""Where images have less than this share of their curvature in common, next to nothing is known."""
_PRIOR_STD = 0.03
"""How much a parameter that a backend leaves alone may be off, in coordinates of unit size: two exposures roll against each
other by a degree or two at most, and differ as little in scale, shear and perspective."""


def motion_from_images(
    moving: View,
    fixed: View,
    homography: Homography,
    limits: ImageLimits,
    *,
    free: Sequence[int] = ALL,
    efficiency: float = 1.0,
    evidence: Mapping[str, float] | None = None,
) -> Located | NotLocated:
    """Judge the homography with which a backend aligned two images, and say how well it is known. Raises nothing.

    With J the derivatives of brightness and W the inverse photon variances of the difference, the information is J^T W J over
    the ratio of the squared difference to photon noise. The noise of each image has derivatives too, larger than those of the
    scene in the dark, so J^T J is taken between the images: only the scene is common to both.

    Convention:
        The map takes pixels of `moving` to pixels of `fixed`; points are (x, y), integers are pixel centres.

    Args:
        moving: one image.
        fixed: the other one, of the same shape and blur.
        homography: (3, 3) what the backend found.
        limits: what it takes to be believed.
        free: which of p1..p8 the backend estimated; the others are as likely to be off as cameras make them.
        efficiency: which share of the information of the photons the backend uses; least squares uses all of it.
        evidence: what the backend counted, for the record.

    Returns:
        `Located` with its information, the expected error of a corner as `residual_px`, `evidence`, and the numbers that were
        judged; or `NotLocated` where no camera moves like that, where too little overlaps or nothing stands out, where the
        images do not look alike, or where they tell too little about the corners.
    """
    found = dict(evidence or {})
    if reason := why_implausible(homography, moving.shape, limits.min_overlap):
        return NotLocated(reason, found)
    there = fixed.seen_from(homography)
    both = moving.seen & there.seen
    found["overlap"] = float(both.mean())
    if found["overlap"] < limits.min_overlap:
        return NotLocated(
            f"after alignment both exposures see {found['overlap']:.0%} of the image, "
            f"less than min_overlap = {limits.min_overlap:.0%}",
            found,
        )
    alike = _likeness(moving, there)
    found |= alike.evidence
    if reason := alike.why_different(limits.min_agreement):
        return NotLocated(reason, found)
    weight = np.asarray(1 / (1 / moving.weight[both] + 1 / there.weight[both]), np.float32)
    squares = weight * np.square(moving.image[both] - there.image[both])
    found["noise_ratio"] = float(squares.mean(dtype=np.float64)) / moving.noise_left
    curvature = _common_curvature(_derivatives(moving, both), _derivatives(there, both), weight)
    if curvature is None:
        return NotLocated("where the images overlap after alignment, there is no texture", found)
    known, used = curvature * efficiency / max(1.0, found["noise_ratio"]), list(free)
    # A backend that leaves parameters alone finds the others wrong by what these do to the image.
    rows = known[used]
    information = rows.T @ np.linalg.solve(known[np.ix_(used, used)], rows)
    held = [index for index in ALL if index not in used]
    information[held, held] += _PRIOR_STD**-2.0
    to_corners, to_step = _conversions(homography, moving.shape)
    covariance = np.linalg.inv(known[np.ix_(used, used)])
    std_px = float(np.sqrt(np.trace(to_corners[:, used] @ covariance @ to_corners[:, used].T) / 4))
    if not std_px <= limits.max_std_px:
        return NotLocated(
            f"the images tell where corners lie to {std_px:.2g} px, worse than max_std_px = {limits.max_std_px:g}", found
        )
    return Located(homography, to_step.T @ information @ to_step, std_px, found)


def _likeness(moving: View, there: View) -> Similarity:
    """Return how alike two images on one grid are, in large px."""
    while moving.pixel < _JUDGED_PIXEL and min(moving.shape) >= 2 * _SMALLEST_SIDE:
        moving, there = moving.halved(), there.halved()
    both = moving.seen & there.seen
    pixels = int(np.count_nonzero(both))
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    # Shadows and slopes that fill the image look alike wherever one looks.
    mask = both.astype(np.float32)
    norm = np.maximum(_surroundings(mask), np.float32(1e-6))
    details = [
        np.asarray((view.image - _surroundings(view.image * mask) / norm) * mask, np.float32) for view in (moving, there)
    ]
    noise = [view.noise_left * float(np.mean(1 / view.weight[both])) for view in (moving, there)]
    return similarity_of(
        np.cov(details[0][both], details[1][both]),
        (noise[0], noise[1]),
        pixels,
        pixels * min(1.0, moving.noise_left),
        (autocorrelation(details[0]), autocorrelation(details[1])),
    )


def _surroundings(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the square around each pixel."""
    return np.asarray(cv2.blur(image, (_SURROUNDINGS_PX, _SURROUNDINGS_PX)), np.float32)


def _derivatives(view: View, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return what small changes of p1..p8 in unit coordinates do to the pixels of an image: (N, 8)."""
    height, width = view.shape
    unit = unit_coordinates(view.shape)
    rows, columns = np.nonzero(where)
    x, y = ((unit[axis, axis] * at + unit[axis, 2]).astype(np.float32) for axis, at in enumerate((columns, rows)))
    half = np.float32(max(height, width) / 2)
    along_x, along_y = (half * each[where] for each in _gradients(view))
    inwards = along_x * x + along_y * y
    return np.stack([along_x * x, along_y * x, along_x * y, along_y * y, along_x, along_y, -inwards * x, -inwards * y], axis=1)


def _gradients(view: View) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return central differences along x and y; 0 where a neighbour was not seen, so that no edge is one of the scene."""
    differences = []
    for kernel in (np.array([[-0.5, 0, 0.5]]), np.array([[-0.5], [0], [0.5]])):
        neighbours = cv2.erode(view.seen.astype(np.uint8), np.ones(kernel.shape, np.uint8), borderValue=0)
        differences.append(np.where(neighbours, cv2.filter2D(view.image, -1, kernel), np.float32(0)).astype(np.float32))
    return differences[0], differences[1]


def _common_curvature(
    moving: NDArray[np.float32], there: NDArray[np.float32], weight: NDArray[np.float32]
) -> FloatArray | None:
    """Return the (8, 8) curvature that two images have in common, that of the scene; None if one of them has no texture."""
    weighted = weight[:, None] * there
    own = (moving.T @ (weight[:, None] * moving) + there.T @ weighted).astype(np.float64) / 2
    between = (moving.T @ weighted).astype(np.float64)
    try:
        root = np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        return None
    # In units in which their own is the identity, so that no parameter drowns another.
    whitening = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(whitening @ (between + between.T) @ whitening.T / 2)
    half = root @ vectors * np.sqrt(np.maximum(values, _UNKNOWN))
    return np.asarray(half @ half.T)


def _conversions(homography: Homography, shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return how small steps in unit coordinates of the moving image move its corners, and p1..p8 in terms of such steps.

    Returns:
        (8, 8) the derivatives of the mapped corners with respect to a step, and (8, 8) those of a step with respect to p1..p8.
    """
    rows = np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
    to_corners = slopes(homography @ rows, homography @ generators(shape) @ rows)
    return to_corners, np.asarray(np.linalg.solve(to_corners, jacobian(homography, corners(shape)).reshape(8, 8)))
