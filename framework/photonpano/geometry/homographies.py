"""Build, apply, compose and rescale homographies; convert them to and from the eight parameters of the paper.

Convention:
    Points are (x, y), x right, y down; integer coordinates are pixel centres; sizes are (height, width). A homography is
    (3, 3) float64 with h33 = 1 and maps column vectors (x, y, 1). All functions take stacks (..., 3, 3) as well.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from photonpano.values import FloatArray, Homography

BLOCK_FRAMES = 8192  # what is computed of all frames of a capture is computed for this many at a time, which bounds the memory
PATCHES = 12  # along each side of an image
_PARAMETERS = ((0, 0), (1, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 0), (2, 1))  # row and column of p1..p8


def normalised(matrices: ArrayLike) -> Homography:
    """Scale (..., 3, 3) matrices so that h33 = 1; `ValueError` if one of these is zero or not finite."""
    matrices = np.asarray(matrices, dtype=np.float64)
    h33 = matrices[..., 2, 2]
    if not (np.isfinite(matrices).all() and h33.all()):
        raise ValueError("a homography must be finite and have h33 other than 0")
    return np.asarray(matrices / h33[..., None, None])


def scaled_ahead(matrices: ArrayLike) -> Homography:
    """Scale (..., 3, 3) matrices so that h33 = 1 where it is positive; others keep their sign: it is negative behind a camera.

    Raises a `ValueError` if a matrix is not finite.
    """
    return _scaled_ahead(np.array(matrices, dtype=np.float64))


def inverse(homographies: Homography) -> Homography:
    """Return the inverse maps, (..., 3, 3) with h33 = 1 where that can be: see `scaled_ahead`."""
    return _scaled_ahead(np.asarray(np.linalg.inv(homographies), dtype=np.float64))


def _scaled_ahead(matrices: Homography) -> Homography:
    """Scale matrices in place."""
    if not np.isfinite(matrices).all():
        raise ValueError("a homography must be finite")
    h33 = matrices[..., 2, 2]
    matrices /= np.where(h33 > 0, h33, 1.0)[..., None, None]
    return matrices


def translation(x: float, y: float) -> Homography:
    """Return the map that adds (x, y) pixels."""
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def step_motions(steps: ArrayLike, shape: tuple[int, int]) -> Homography:
    """Return the maps of small motions of a frame of (height, width): (..., 4) to (..., 3, 3).

    The steps are shifts along x and along y, in pixels; roll about the centre, from x towards y, in radians; zoom, as a
    fraction.
    """
    x, y, roll, zoom = np.moveaxis(np.asarray(steps, dtype=np.float64), -1, 0)
    centre = translation((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    motions = np.zeros((*x.shape, 3, 3))
    motions[..., 0, 0] = motions[..., 1, 1] = (1 + zoom) * np.cos(roll)
    motions[..., 1, 0] = (1 + zoom) * np.sin(roll)
    motions[..., 0, 1] = -motions[..., 1, 0]
    motions[..., 0, 2], motions[..., 1, 2], motions[..., 2, 2] = x, y, 1
    return np.asarray(centre @ motions @ inverse(centre))


def steps_of(motions: Homography, shape: tuple[int, int]) -> FloatArray:
    """Return the steps of small motions of a frame, (..., 3, 3) to (..., 4): see `step_motions`."""
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    points = transform_points(motions, middle + np.array([[0, 0], [-0.5, 0], [0.5, 0]]))
    along = points[..., 2, :] - points[..., 1, :]
    roll, zoom = np.arctan2(along[..., 1], along[..., 0]), np.hypot(along[..., 0], along[..., 1]) - 1
    return np.concatenate([points[..., 0, :] - middle, np.stack([roll, zoom], axis=-1)], axis=-1)


@cache
def rescaling(scale: float) -> Homography:
    """Return the map from pixels of an image to pixels of the same image rescaled: `(p + 0.5) * scale - 0.5`."""
    offset = 0.5 * scale - 0.5
    matrix = np.array([[scale, 0.0, offset], [0.0, scale, offset], [0.0, 0.0, 1.0]])
    matrix.flags.writeable = False
    return matrix


def rescaled(homographies: Homography, scale: float) -> Homography:
    """Return the same (..., 3, 3) motions between images that are both rescaled by `scale`."""
    if scale == 1:
        return normalised(homographies)
    return normalised(rescaling(scale) @ homographies @ rescaling(1 / scale))


def transform_points(homographies: Homography, points: ArrayLike) -> FloatArray:
    """Map (N, 2) points, or (..., N, 2) with one set for each of (..., 3, 3) homographies, to (..., N, 2).

    They are infinite or NaN where a point goes to infinity.
    """
    points = np.asarray(points, dtype=np.float64)
    mapped = points @ np.swapaxes(homographies[..., :2, :2], -1, -2) + homographies[..., None, :2, 2]
    depth = points @ homographies[..., 2, :2, None] + homographies[..., None, 2:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped / depth)


apply = transform_points  # deprecated: use `transform_points`


def jacobian(homography: Homography, points: ArrayLike) -> FloatArray:
    """Return the derivatives of (N, 2) mapped points with respect to p1..p8 of `parameters`: (N, 2, 8)."""
    points = np.asarray(points, dtype=np.float64)
    depth = points @ homography[2, :2] + homography[2, 2]
    x, y = points.T / depth
    u, v = transform_points(homography, points).T
    zero, one = np.zeros_like(x), 1 / depth
    return np.stack(
        [
            np.stack([x, zero, y, zero, one, zero, -u * x, -u * y], axis=-1),
            np.stack([zero, x, zero, y, zero, one, -v * x, -v * y], axis=-1),
        ],
        axis=1,
    )


@cache
def corners(shape: tuple[int, int]) -> FloatArray:
    """Return the centres of the corner pixels of a (height, width) image, clockwise from the top left: (4, 2)."""
    height, width = shape
    points = np.array([[0, 0], [width - 1, 0], [width - 1, height - 1], [0, height - 1]], dtype=np.float64)
    points.flags.writeable = False
    return points


def patch_centres(shape: tuple[int, int]) -> FloatArray:
    """Return the middles of the patches into which an image of (height, width) is divided, row by row: (P, 2), P = 12 x 12."""
    y, x = ((np.arange(PATCHES) + 0.5) * side / PATCHES - 0.5 for side in shape)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def corner_displacements(first: Homography, second: Homography, shape: tuple[int, int]) -> FloatArray:
    """Return the distances, in pixels, between the four corners of an image under one map and under another: (..., 4)."""
    frame = corners(shape)
    return np.asarray(np.linalg.norm(transform_points(first, frame) - transform_points(second, frame), axis=-1))


def steps_px(homographies: Homography, shape: tuple[int, int]) -> FloatArray:
    """Return how far, in px, the corners of an image of (height, width) move from each map to the next: (N - 1, 4)."""
    moved = np.empty((max(len(homographies) - 1, 0), 4))
    for start in range(0, len(moved), BLOCK_FRAMES):
        block = homographies[start : start + BLOCK_FRAMES + 1]
        moved[start : start + BLOCK_FRAMES] = corner_displacements(inverse(block[:-1]) @ block[1:], np.eye(3), shape)
    return moved


def parameters(homographies: Homography) -> FloatArray:
    """Return p1..p8 of the paper (section 4, "Interpolate"): (..., 8).

    They fill the homography as [[1 + p1, p3, p5], [p2, 1 + p4, p6], [p7, p8, 1]], so that zeros are the identity.
    """
    h = np.asarray(homographies, dtype=np.float64) - np.eye(3)
    return np.stack([h[..., row, column] for row, column in _PARAMETERS], axis=-1)


def from_parameters(p: ArrayLike) -> Homography:
    """Return the homographies of p1..p8: (..., 8) to (..., 3, 3)."""
    p = np.asarray(p, dtype=np.float64)
    h = np.broadcast_to(np.eye(3), (*p.shape[:-1], 3, 3)).copy()
    for index, (row, column) in enumerate(_PARAMETERS):
        h[..., row, column] += p[..., index]
    return h


@cache
def unit_coordinates(shape: tuple[int, int]) -> Homography:
    """Return the map from pixels of a (height, width) image to coordinates with -1 and 1 at the ends of its longer side."""
    height, width = shape
    half = max(height, width) / 2
    unit = np.array([[1 / half, 0, (1 - width) / (2 * half)], [0, 1 / half, (1 - height) / (2 * half)], [0, 0, 1]])
    unit.flags.writeable = False
    return unit


@cache
def generators(shape: tuple[int, int]) -> FloatArray:
    """Return the derivatives of a homography of pixels by p1..p8 of `unit_coordinates`, at the identity: (8, 3, 3).

    To first order, a change by p in unit coordinates is the homography I + p1 G1 + ... + p8 G8 of pixels.
    """
    unit = unit_coordinates(shape)
    changes = np.asarray(np.linalg.inv(unit) @ (from_parameters(np.eye(8)) - np.eye(3)) @ unit)
    changes.flags.writeable = False
    return changes


def slopes(mapped: FloatArray, changes: FloatArray) -> FloatArray:
    """Return the derivatives of mapped points by eight parameters: (..., 2 N, 8), x and y of a point in adjacent rows.

    The mapped points, (..., 3, N), are in homogeneous coordinates, `changes`, (..., 8, 3, N), their derivatives.
    """
    depth = mapped[..., None, 2:, :]
    points = mapped[..., None, :2, :] / depth
    d = (changes[..., :2, :] - points * changes[..., 2:, :]) / depth
    return np.asarray(np.moveaxis(d, -3, -1).swapaxes(-3, -2).reshape(*d.shape[:-3], -1, d.shape[-3]))


def moving_corners(displacements: FloatArray, shape: tuple[int, int]) -> Homography:
    """Return the homographies that move the corners of an image of (height, width) by small displacements, to first order.

    The displacements are (N, 8), x and y of each corner, in pixels.
    """
    here = np.concatenate([corners(shape), np.ones((4, 1))], axis=1).T
    of_corners = slopes(here, generators(shape) @ here)
    steps = np.linalg.solve(of_corners, displacements.T).T
    return normalised(np.eye(3) + np.einsum("np,pij->nij", steps, generators(shape)))


class FrameTrajectory:
    """A trajectory given at every frame: linear between frames, constant beyond the first and last.

    Args:
        homographies: (T, 3, 3) float64, frame pixels to reference pixels, h33 = 1.
    """

    def __init__(self, homographies: FloatArray) -> None:
        self._homographies = np.asarray(homographies, dtype=np.float64)

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants, in frames: (N, 3, 3)."""
        instants = np.asarray(frame_indices, dtype=np.float64)
        found, last = np.empty((len(instants), 3, 3)), len(self._homographies) - 1
        for start in range(0, len(instants), BLOCK_FRAMES):
            block = np.clip(instants[start : start + BLOCK_FRAMES], 0, last)
            before = np.floor(block).astype(int)
            share = (block - before)[:, None, None]
            after = np.minimum(before + 1, last)
            found[start : start + len(block)] = (1 - share) * self._homographies[before] + share * self._homographies[after]
        return found
