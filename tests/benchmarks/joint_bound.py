"""The Cramer-Rao bound on the motion of a whole capture whose panorama is not known either.

A pixel x of the panorama is lit with an unknown probability p(x) = 1 - exp(-flux). Of it, n_i frames of view i tell with the
weight w_i = n_i / (p (1 - p)). J_i(x), the derivatives of what view i sees there by the numbers of its motion, are the gradient
of p times those of the place that it sees. The panorama eliminated, the information on the numbers is

    sum over x of [ sum_i w_i J_i' J_i - (sum_i w_i J_i)' (sum_i w_i J_i) / sum_i w_i ]

The gradient is the central difference of p at the pixels of the scene, which are as large as those of a frame: it keeps 64 % of
the slope of detail of 4 px and none of that of 2 px. p (1 - p) is that of the mean of 3x3 pixels, so that black next to an edge
has no weight without limit. This bound holds for any unbiased estimate, and none reaches it where detail is weaker than noise:
the panorama that an exposure is compared with is made of the same photons. So the gradient is also limited to what they show:
each of six octaves, by the root of S / (S + N), where S is the mean square of its gradient nearby and N that of the noise.

The motion is a cubic spline in time, its nodes as far apart as the true motion allows within `TOLERANCE_PX`. The choice of the
plane, of which no photon tells, drops out: corners are compared after the best alignment of the planes, as in an evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.special import ellipe

from photonpano.geometry import ROTATION_AXES, Camera, corners, generators, slopes, transform_points

SPACINGS, TOLERANCE_PX = (500, 400, 250, 200, 160, 125, 100, 80, 64, 50), 0.02
VIEW_FRAMES = 50  # most frames that are taken to lie at one place
PIXELS = 8192  # of the panorama that are summed at a time
PLANE = 1e-7  # a change that moves corners, after alignment, and is known, relatively less than this, is one of the plane
UNKNOWN = 1e-12  # information, relative to the largest, that is none
HALF_STEP = 1e-4  # of numerical derivatives by the logarithm of the focal length, k1 and k2
OCTAVES_PX = (0.7, 1.4, 2.8, 5.6, 11.2)  # standard deviations of the Gaussian kernels between octaves
_P = np.eye(8)  # p1..p8 of `generators`, which are the elements a, d, b, e, c, f, g, h of a homography
MODELS = {
    "translation": _P[4:6],
    "euclidean": np.array([_P[4], _P[5], _P[1] - _P[2]]),
    "similarity": np.array([_P[4], _P[5], _P[1] - _P[2], _P[0] + _P[3]]),
    "affine": _P[:6],
    "homography": _P,
}
Array = NDArray[np.float64]


class Bound(NamedTuple):
    """Least mean and root mean square error of the corners of frames, in px, and the frames between nodes."""

    mean_px: float
    rms_px: float
    spacing: int


@dataclass(frozen=True)
class Model:
    """How frames move: their homographies map ideal pixels, those of a lens without distortion, to the scene.

    `moves` (k, 3, 3) are the derivatives of a small motion by the numbers of a frame; `shared` (s, 3, H W) those of the ideal
    pixels by the numbers of all frames; `area` (H W) is that of a pixel in ideal pixels; `corners` (8, k + s) are the
    derivatives of the corners in pixels of the frame.
    """

    shape: tuple[int, int]
    camera: Camera
    moves: Array
    shared: Array
    area: Array
    corners: Array

    @classmethod
    def of(cls, name: str, shape: tuple[int, int], camera: Camera | None = None, n_shared: int = 0) -> Model:
        """Return one of `MODELS`, or "rotation" of a camera; 1 or 3 numbers that frames share are its focal length, k1, k2."""
        ours = camera or Camera.of(1.0, shape)
        if name == "rotation":
            moves = max(shape) / 2 / ours.focal_px * ours.matrix @ ROTATION_AXES @ np.linalg.inv(ours.matrix)
        else:
            moves = np.einsum("kp,pij->kij", MODELS[name], generators(shape))
        grid = np.moveaxis(np.indices(shape, np.float64)[::-1], 0, -1)
        down, right = np.gradient(ours.ideal(grid), axis=(0, 1))
        area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0]).ravel()
        to_frame, there = np.linalg.inv(ours.ideal_at_corners(shape)), _homogeneous(ours.ideal(corners(shape)))
        moved = np.concatenate([moves @ there, _shared(ours, shape, n_shared, corners(shape))])
        shared = _shared(ours, shape, n_shared, grid.reshape(-1, 2))
        return cls(shape, ours, moves, shared, area, slopes(to_frame @ there, to_frame @ moved))


def _homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1).T


def _shared(camera: Camera, shape: tuple[int, int], n_shared: int, points: Array) -> Array:
    """Return the derivatives of the ideal pixels of (N, 2) pixels by the numbers of a camera that keeps still: (s, 3, N)."""
    changes = np.zeros((n_shared, 3, len(points)))
    for index, sign in np.ndindex(n_shared, 2):
        focal, k1, k2 = (2 * sign - 1) * HALF_STEP * np.eye(3)[index]
        changed = Camera.of(camera.focal_px * np.exp(focal), shape, camera.distortion + np.array([k1, k2, 0, 0]))
        x, y, z = changed.directions(points).T
        changes[index, :2] += (2 * sign - 1) * camera.focal_px * np.array([x / z, y / z]) / (2 * HALF_STEP)
    return changes


def gradient(chance: Array, variance: Array, limited: bool) -> tuple[Array, Array]:
    """Return the gradient of p, (H, W), down and to the right; `limited` to what noise of a variance at each pixel leaves."""
    if not limited:
        return np.gradient(chance)
    gradients, point = np.zeros((2, *chance.shape)), np.zeros((129, 129), np.float32)
    point[64, 64] = 1
    octaves = _octaves(chance.astype(np.float32)), _octaves(point)
    for sigma, octave, (kernel, _) in zip((*OCTAVES_PX, OCTAVES_PX[-1]), *octaves, strict=True):
        power = cv2.GaussianBlur((octave**2).mean(axis=0), (0, 0), max(4.0, 3 * sigma))
        gradients += np.sqrt(power / (power + variance * (kernel**2).sum())) * octave
    return gradients[0], gradients[1]


def _octaves(image: Array) -> list[Array]:
    """Return the gradients of the octaves of an image, from fine to coarse, (2, H, W) each."""
    blurred = [image, *(cv2.GaussianBlur(image, (0, 0), sigma) for sigma in OCTAVES_PX), np.zeros_like(image)]
    return [np.array(np.gradient(finer - coarser)) for finer, coarser in pairwise(blurred)]


def information(scene: NDArray[Any], views: Array, n_frames: Array, model: Model, step: int, limited: bool) -> Array:
    """Return the information on the motion of views: (V k + s, V k + s), shared numbers last.

    `scene` is (Hs, Ws) flux, of which every `step`-th pixel along each axis is summed. `views`, (V, 3, 3), map ideal pixels of
    a frame to those of the scene, and stand for (V,) `n_frames`. `limited` is that of `gradient`.
    """
    chance = -np.expm1(-np.asarray(scene, np.float64))
    level = np.clip(cv2.blur(chance, (3, 3)), 1e-9, 1 - 1e-9)
    of_frame, size = np.ones(model.shape, np.float32), scene.shape[::-1]
    seen = sum(n * cv2.warpPerspective(of_frame, view, size) for n, view in zip(n_frames, views, strict=True))
    down, right = gradient(chance, level * (1 - level) / np.maximum(seen, 1), limited)
    k, s, n, (height, width) = len(model.moves), len(model.shared), len(views), model.shape
    y, x = (each.ravel() for each in np.mgrid[step // 2 : scene.shape[0] : step, step // 2 : scene.shape[1] : step])
    to_frames, total = np.linalg.inv(views), np.zeros((n * k + s, n * k + s))
    for first in range(0, len(x), PIXELS):
        column, row = x[first : first + PIXELS], y[first : first + PIXELS]
        sums, weights = np.zeros((len(row), n * k + s)), np.full(len(row), 1e-300)
        for view in range(n):
            ideal = to_frames[view] @ _homogeneous(np.stack([column, row], axis=-1))
            depth, ideal = ideal[2], ideal / ideal[2]
            u, v = np.nan_to_num(model.camera.distorted(ideal[:2].T), nan=-1e6).round().T
            at = np.flatnonzero((depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
            pixel, here = (v[at] * width + u[at]).astype(int), (row[at], column[at])
            density = np.abs(np.linalg.det(to_frames[view]) / depth[at] ** 3) / model.area[pixel]
            weight = n_frames[view] * step**2 * density / (level[here] * (1 - level[here]))
            changes = views[view] @ np.concatenate([model.moves @ ideal[:, at], model.shared[:, :, pixel]])
            moved = slopes(views[view] @ ideal[:, at], changes).reshape(-1, 2, k + s)
            slope = right[here][:, None] * moved[:, 0] + down[here][:, None] * moved[:, 1]
            which = np.r_[view * k : view * k + k, n * k : n * k + s]
            total[np.ix_(which, which)] += slope.T @ (weight[:, None] * slope)
            sums[np.ix_(at, which)] += weight[:, None] * slope
            weights[at] += weight
        sums /= np.sqrt(weights)[:, None]
        total -= sums.T @ sums
    return total


def joint_bound(scene: NDArray[Any], homographies: Array, model: Model, step: int = 3, limited: bool = True) -> Bound:
    """Return the bound of the motion of all frames: (T, 3, 3), ideal pixels of a frame to pixels of the scene."""
    spacing, n = spacing_of(homographies, model.shape), len(homographies)
    n_views = round(n / min(VIEW_FRAMES, spacing / 2))
    instants = (np.arange(n_views) + 0.5) * n / n_views - 0.5
    spline = block_diag(np.kron(_spline(n, spacing, instants), np.eye(len(model.moves))), np.eye(len(model.shared)))
    views = homographies[instants.round().astype(int)]
    of_views = information(scene, views, np.full(n_views, n / n_views), model, step, limited)
    return Bound(*corner_errors_px(spline.T @ of_views @ spline, views, model, spline), spacing)


def corner_errors_px(known: Array, views: Array, model: Model, spline: Array) -> tuple[float, float]:
    """Return the mean and root mean square corner error of views after alignment, given information on unknowns.

    `spline` maps the unknowns to the numbers of each view and the shared ones, (V k + s, U).
    """
    n, k = len(views), len(model.moves)
    moved = np.hstack([np.kron(np.eye(n), model.corners[:, :k]), np.tile(model.corners[:, k:], (n, 1))]) @ spline
    to_scene, here = views @ model.camera.ideal_at_corners(model.shape), _homogeneous(corners(model.shape))
    by_plane = np.linalg.inv(to_scene)[:, None] @ generators(model.shape) @ to_scene[:, None] @ here
    planes = np.linalg.qr(slopes(np.broadcast_to(here, (n, 3, 4)), by_plane).reshape(-1, 8))[0]
    # Numbers in units of their own information, as they differ by many orders of magnitude.
    unit = 1 / np.sqrt(np.maximum(np.diag(known), UNKNOWN * np.diag(known).max()))
    moved, known = (moved - planes @ (planes.T @ moved)) * unit, known * np.outer(unit, unit)
    # A lens may move no corner, and the rest of the frame yet: what is known of it counts.
    sizes, directions = np.linalg.eigh(known + moved.T @ moved / np.linalg.norm(moved, 2) ** 2)
    kept = directions[:, sizes > PLANE]
    values, axes = np.linalg.eigh(kept.T @ known @ kept)
    errors = (moved @ kept @ axes / np.sqrt(np.maximum(values, UNKNOWN * values[-1]))).reshape(n, 4, 2, -1)
    narrow, wide = np.moveaxis(np.maximum(np.linalg.eigvalsh(errors @ errors.swapaxes(-1, -2)), 0), -1, 0)
    mean = np.sqrt(2 * wide / np.pi) * ellipe(1 - narrow / wide)  # of the length of a Gaussian vector
    return float(mean.mean()), float(np.sqrt((narrow + wide).mean()))


def spacing_of(homographies: Array, shape: tuple[int, int]) -> int:
    """Return the largest of `SPACINGS` at which a spline represents the corners of all frames within `TOLERANCE_PX`."""
    frames = np.arange(0, len(homographies), 10)
    there = transform_points(homographies[frames], corners(shape)).reshape(len(frames), -1)
    for spacing in SPACINGS[:-1]:
        basis = _spline(len(homographies), spacing, frames)
        if np.abs(basis @ np.linalg.lstsq(basis, there, rcond=None)[0] - there).max() <= TOLERANCE_PX:
            return spacing
    return SPACINGS[-1]


def _spline(n_frames: int, spacing: int, instants: NDArray[Any]) -> Array:
    """Return the values of a cubic spline at instants by those at its nodes: (N, nodes)."""
    nodes = np.linspace(0, n_frames - 1, max(4, round(n_frames / spacing) + 1))
    return np.asarray(CubicSpline(nodes, np.eye(len(nodes)))(instants))
