"""What all locators that align brightness share: from coarse to fine, and from aligned images to an accepted motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import corners, generators, jacobian, rescaled, slopes, unit_coordinates, why_implausible
from photonpano.locating.configs import ImageLimits
from photonpano.locating.viewing import View
from photonpano.photometry import Similarity, autocorrelation, similarity_of, without_local_mean
from photonpano.values import BoolArray, FloatArray, Homography, Located, NotLocated

ALL_PARAMETERS = (0, 1, 2, 3, 4, 5, 6, 7)  # indices of p1..p8
TRANSLATION = (4, 5)  # indices of the parameters of a translation, p5 and p6
_AFFINE = (0, 1, 2, 3, 4, 5)
# Prior standard deviation of p1..p4, p7 and p8 in unit coordinates: between two exposures a camera rolls by 1 or 2 degrees, and
# scale, shear and perspective change as little.
PRIOR_STD = 0.03
MIN_COMMON_CURVATURE = 1e-3  # floor on the eigenvalues of the curvature that two images have in common, relative to their own
SMALLEST_SIDE = 24  # images are not halved to fewer pixels than this along a side
_COMPARED_PIXEL = 4  # images are compared in pixels 4 times as large, where noise is small and motion blur hardly matters

# Reasons of `NotLocated`.
NO_TEXTURE = "the images do not overlap, or there is no texture where they do"
NOTHING_SEEN = "all pixels are masked, or too near to masked ones"


def free_parameters(depth: int, layers: int) -> tuple[int, ...]:
    """Return which of p1..p8 to estimate on a layer of a pyramid.

    Few pixels determine few parameters: a translation on the coarsest layer, an affine map on the next, then all eight.

    Args:
        depth: number of the layer, 0 for the finest. The finest layer always estimates all eight.
        layers: number of layers of the pyramid.
    """
    from_coarsest = layers - 1 - depth
    return (TRANSLATION, _AFFINE)[from_coarsest] if depth > 0 and from_coarsest < 2 else ALL_PARAMETERS


def coarse_to_fine(
    moving: Sequence[View],
    fixed: Sequence[View],
    start: Homography,
    align: Callable[[View, View, Homography, int], Homography | NotLocated],
) -> tuple[list[Homography], NotLocated | None]:
    """Align two pyramids layer by layer. A layer that fails is skipped: the next one starts where it started.

    Args:
        moving: views of one exposure, finest first.
        fixed: views of the other one.
        start: (3, 3) initial map, in pixels of the finest views.
        align: returns the map between two views, given an initial one and the depth of the layer, in pixels of these views.

    Returns:
        The maps of the layers that could be aligned, coarsest first, in pixels of the finest views; and why the finest layer
        could not be aligned, None if it could.
    """
    found: list[Homography] = []
    failure = None
    for depth in reversed(range(len(moving))):
        pixel = moving[depth].pixel
        outcome = align(moving[depth], fixed[depth], rescaled(start, 1 / pixel), depth)
        failure = outcome if isinstance(outcome, NotLocated) else None
        if not isinstance(outcome, NotLocated):
            start = rescaled(outcome, pixel)
            found.append(start)
    return found, failure


def motion_from_images(
    moving: View,
    fixed: View,
    homography: Homography,
    limits: ImageLimits,
    *,
    free: Sequence[int] = ALL_PARAMETERS,
    efficiency: float = 1.0,
    evidence: Mapping[str, float] | None = None,
) -> Located | NotLocated:
    """Accept or reject the homography that aligns two images, and compute its information. Raises nothing.

    With J the derivatives of brightness and W the inverse variances of the difference, the information is J^T W J over the
    ratio of the squared difference to photon noise. In the dark, noise has larger derivatives than the scene; so J^T J is the
    product of the derivatives of one image and those of the other, which have only the scene in common.

    Convention:
        The map takes pixels of `moving` to pixels of `fixed`; points are (x, y), integers are pixel centres.

    Args:
        moving: one image.
        fixed: the other one, of the same shape and blur.
        homography: (3, 3) estimate of the backend.
        limits: thresholds of acceptance.
        free: indices of the parameters p1..p8 that the backend estimated; the others get a weak prior.
        efficiency: fraction of the photons' information that the estimator uses; 1 for least squares.
        evidence: counts of the backend, for the record.

    Returns:
        `Located` with its information, the expected error of a corner as `residual_px`, `evidence`, and the numbers that
        decided; `NotLocated` if no camera moves like that, if the overlap is too small, if the images differ or have no
        texture, or if they leave the corners uncertain.
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
    similarity = _similarity(moving, there)
    found |= similarity.evidence
    if reason := similarity.why_different(limits.min_agreement):
        return NotLocated(reason, found)
    weight = np.asarray(1 / (1 / moving.weight[both] + 1 / there.weight[both]), np.float32)
    squares = weight * np.square(moving.image[both] - there.image[both])
    found["noise_ratio"] = float(squares.mean(dtype=np.float64)) / moving.noise_left
    curvature = _common_curvature(_derivatives(moving, both), _derivatives(there, both), weight)
    if curvature is None:
        return NotLocated("where the images overlap after alignment, there is no texture", found)
    curvature, estimated = curvature * efficiency / max(1.0, found["noise_ratio"]), list(free)
    # Errors of the parameters that are held bias those that are estimated.
    rows = curvature[estimated]
    information = rows.T @ np.linalg.solve(curvature[np.ix_(estimated, estimated)], rows)
    held = [index for index in ALL_PARAMETERS if index not in estimated]
    information[held, held] += PRIOR_STD**-2.0
    # Derivatives (8, 8) of mapped corners by a small step in unit coordinates, and of a step by p1..p8.
    rows = np.concatenate([corners(moving.shape), np.ones((4, 1))], axis=1).T
    to_corners = slopes(homography @ rows, homography @ generators(moving.shape) @ rows)
    to_step = np.linalg.solve(to_corners, jacobian(homography, corners(moving.shape)).reshape(8, 8))
    covariance = np.linalg.inv(curvature[np.ix_(estimated, estimated)])
    std_px = float(np.sqrt(np.trace(to_corners[:, estimated] @ covariance @ to_corners[:, estimated].T) / 4))
    if not std_px <= limits.max_std_px:
        return NotLocated(
            f"the images leave the corners uncertain by {std_px:.2g} px, more than max_std_px = {limits.max_std_px:g}", found
        )
    return Located(homography, to_step.T @ information @ to_step, std_px, found)


def _similarity(moving: View, there: View) -> Similarity:
    """Return the similarity of two images on one grid, in large pixels."""
    while moving.pixel < _COMPARED_PIXEL and min(moving.shape) >= 2 * SMALLEST_SIDE:
        moving, there = moving.halved(), there.halved()
    both = moving.seen & there.seen
    pixels = int(np.count_nonzero(both))
    if not pixels:
        return Similarity(0.0, 0.0, 0.0)
    first, second = (without_local_mean(view.image, both) for view in (moving, there))
    noise = [view.noise_left * float(np.mean(1 / view.weight[both])) for view in (moving, there)]
    return similarity_of(
        np.cov(first[both], second[both]),
        (noise[0], noise[1]),
        pixels,
        pixels * min(1.0, moving.noise_left),
        (autocorrelation(first), autocorrelation(second)),
    )


def _derivatives(view: View, where: BoolArray) -> NDArray[np.float32]:
    """Return the derivatives of pixels with respect to p1..p8 in unit coordinates: (N, 8)."""
    height, width = view.shape
    unit = unit_coordinates(view.shape)
    rows, columns = np.nonzero(where)
    x, y = ((unit[axis, axis] * at + unit[axis, 2]).astype(np.float32) for axis, at in enumerate((columns, rows)))
    half = np.float32(max(height, width) / 2)
    along = []
    for kernel in (np.array([[-0.5, 0, 0.5]]), np.array([[-0.5], [0], [0.5]])):
        # Central differences; 0 where a neighbour is masked.
        neighbours = cv2.erode(view.seen.astype(np.uint8), np.ones(kernel.shape, np.uint8), borderValue=0)
        difference = np.where(neighbours, cv2.filter2D(view.image, -1, kernel), np.float32(0)).astype(np.float32)
        along.append(half * difference[where])
    along_x, along_y = along
    inwards = along_x * x + along_y * y
    return np.stack([along_x * x, along_y * x, along_x * y, along_y * y, along_x, along_y, -inwards * x, -inwards * y], axis=1)


def _common_curvature(
    moving: NDArray[np.float32], there: NDArray[np.float32], weight: NDArray[np.float32]
) -> FloatArray | None:
    """Return the (8, 8) curvature that two images have in common, which is that of the scene; None without texture."""
    weighted = weight[:, None] * there
    own = (moving.T @ (weight[:, None] * moving) + there.T @ weighted).astype(np.float64) / 2
    between = (moving.T @ weighted).astype(np.float64)
    try:
        root = np.linalg.cholesky(own)
    except np.linalg.LinAlgError:
        return None
    # Whitened by their own curvature, so that all parameters have the same scale.
    whitening = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(whitening @ (between + between.T) @ whitening.T / 2)
    half = root @ vectors * np.sqrt(np.maximum(values, MIN_COMMON_CURVATURE))
    return np.asarray(half @ half.T)
