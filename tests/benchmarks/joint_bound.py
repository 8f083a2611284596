"""The Cramer-Rao bound on the motion of a whole capture, of which the panorama is not known either.

A pixel x of the panorama is lit with an unknown probability p(x) = 1 - exp(-flux). View i, some frames at one place, tells of
it with the weight w_i = n_i / (p (1 - p)), where n_i frames see it. J_i(x), the derivatives of what view i sees there by the
unknowns of its motion, are the gradient of p times those of the place that it sees. Without p(x), the unknowns are left with

    information = sum over x of [ sum_i w_i J_i' J_i - (sum_i w_i J_i)' (sum_i w_i J_i) / sum_i w_i ]

The gradient is the central difference of the true p at the pixels of the scene, which are as large as those of a frame. It
keeps 64 % of the slope of detail of 4 px and nothing of that of 2 px, about as linear interpolation between pixels does.
p (1 - p) is that of the mean of 3x3 pixels, so that black next to an edge has no weight without limit.

The motion is a cubic spline in time, through nodes that are as far apart as the true motion allows within `TOLERANCE_PX`. What
no photon tells, the choice of the plane, is left out: corners are compared after the best alignment of the planes, as an
evaluation aligns them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from scipy.special import ellipe

from photonpano.geometry import ROTATION_AXES, Camera, corners, generators, slopes, transform_points

SPACINGS, TOLERANCE_PX = (500, 400, 250, 200, 160, 125, 100, 80, 64, 50), 0.02
EVERY = 10  # frames between those that a spline is fitted to
VIEW_FRAMES = 50  # most frames that are taken to lie at one place
PIXELS = 8192  # of the panorama that are summed at a time
PLANE = 1e-7  # a change that moves corners, after alignment, and is known, relatively less than this, is one of the plane
UNKNOWN = 1e-12  # information, relative to the largest, that is none
HALF_STEP = 1e-4  # of numerical derivatives by the logarithm of the focal length, k1 and k2

# The numbers of a frame: combinations of the derivatives of p1..p8, whose order is a, d, b, e, c, f, g, h.
_EYE = np.eye(8)
MODELS = {
    "translation": _EYE[[4, 5]],
    "euclidean": np.stack([*_EYE[[4, 5]], _EYE[1] - _EYE[2]]),
    "similarity": np.stack([*_EYE[[4, 5]], _EYE[1] - _EYE[2], _EYE[0] + _EYE[3]]),
    "affine": _EYE[:6],
    "homography": _EYE,
}


class Bound(NamedTuple):
    """Errors of the corners of frames that no unbiased estimate undercuts, in px, and the frames between nodes.

    `mean_px` and `rms_px` are over corners and frames; `worst_px` is the expected error of the worst frame.
    """

    mean_px: float
    rms_px: float
    worst_px: float
    spacing: int


@dataclass(frozen=True)
class Model:
    """How a frame moves, at its pixels: a homography maps ideal pixels, those of a lens without distortion, to the scene.

    Attributes:
        frame_shape: (height, width).
        camera: maps pixels of a frame to ideal ones.
        moves: (k, 3, 3) derivatives of the small motion of a frame by its numbers.
        shared: (s, 3, H W) derivatives of the ideal pixels, homogeneous, by the numbers that all frames share.
        area: (H W) ideal pixels in a pixel.
        corner_changes: (8, k + s) derivatives of the corners of a frame, in its pixels.
    """

    frame_shape: tuple[int, int]
    camera: Camera
    moves: NDArray[np.float64]
    shared: NDArray[np.float64]
    area: NDArray[np.float64]
    corner_changes: NDArray[np.float64]

    @classmethod
    def of(cls, name: str, frame_shape: tuple[int, int], camera: Camera | None = None, n_shared: int = 0) -> Model:
        """Return one of `MODELS`, or "rotation" of a camera; 1 or 3 numbers that are shared are its focal length, k1 and k2."""
        ours = camera or Camera.of(1.0, frame_shape)
        if name == "rotation":
            unit = max(frame_shape) / 2 / ours.focal_px
            moves = unit * ours.matrix @ ROTATION_AXES @ np.linalg.inv(ours.matrix)
        else:
            moves = np.einsum("kp,pij->kij", MODELS[name], generators(frame_shape))
        height, width = frame_shape
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
        down, right = np.gradient(ours.ideal(grid), axis=(0, 1))
        area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
        shared = _shared(ours, n_shared, grid.reshape(-1, 2))
        to_frame, there = np.linalg.inv(lens_at_corners(ours, frame_shape)), _homogeneous(ours.ideal(corners(frame_shape)))
        moved = np.concatenate([moves @ there, _shared(ours, n_shared, corners(frame_shape))])
        return cls(frame_shape, ours, moves, shared, area.ravel(), slopes(to_frame @ there, to_frame @ moved))


def _homogeneous(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1).T


def _shared(camera: Camera, n_shared: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivatives of the ideal pixels of pixels (N, 2) by shared numbers, where rays stay: (s, 3, N)."""
    changes = np.zeros((n_shared, 3, len(points)))
    for index in range(n_shared):
        there, back = (_changed(camera, index, step).directions(points).T for step in (HALF_STEP, -HALF_STEP))
        changes[index, :2] = camera.focal_px * (there[:2] / there[2] - back[:2] / back[2]) / (2 * HALF_STEP)
    return changes


def _changed(camera: Camera, index: int, step: float) -> Camera:
    """Return a camera with another logarithm of its focal length, k1 or k2."""
    if index == 0:
        return replace(camera, matrix=camera.matrix * [[np.exp(step), 1, 1], [1, np.exp(step), 1], [1, 1, 1]])
    distortion = camera.distortion.copy()
    distortion[index - 1] += step
    return replace(camera, distortion=distortion)


def lens_at_corners(camera: Camera, frame_shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the homography from pixels of a frame to ideal pixels that is exact at the corners of the frame: (3, 3)."""
    here = corners(frame_shape)
    return np.asarray(cv2.getPerspectiveTransform(here.astype(np.float32), camera.ideal(here).astype(np.float32)))


def information(
    scene: NDArray[Any], views: NDArray[np.float64], n_frames: Sequence[float] | NDArray[Any], model: Model, step: int = 1
) -> NDArray[np.float64]:
    """Return the information on the motion of views of an unknown scene: (V k + s, V k + s), shared numbers last.

    Args:
        scene: (Hs, Ws) flux.
        views: (V, 3, 3), ideal pixels of a frame to pixels of the scene.
        n_frames: (V,) frames of each view.
        step: px of the scene between those that are summed, along each axis.
    """
    chance = -np.expm1(-np.asarray(scene, np.float64))
    down, right = np.gradient(chance)
    level = np.clip(cv2.blur(chance, (3, 3)), 1e-9, 1 - 1e-9)
    offset, (height, width) = step // 2, model.frame_shape
    k, s, n = len(model.moves), len(model.shared), len(views)
    y, x = (each.ravel() for each in np.mgrid[offset : scene.shape[0] : step, offset : scene.shape[1] : step])
    sharpness, to_frames, total = 1 / (level * (1 - level)), np.linalg.inv(views), np.zeros((n * k + s, n * k + s))
    for start in range(0, len(x), PIXELS):
        column, row = x[start : start + PIXELS], y[start : start + PIXELS]
        points = np.stack([column, row], axis=-1).astype(np.float64)
        weighted, weights = np.zeros((len(points), n * k + s)), np.zeros(len(points))
        for view in range(n):
            ideal = to_frames[view] @ _homogeneous(points)
            depth, ideal = ideal[2], ideal / ideal[2]
            seen = model.camera.distorted(ideal[:2].T)
            u, v = np.nan_to_num(seen, nan=-1e6).round().T
            at = np.flatnonzero((depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height))
            if not len(at):
                continue
            pixel = (v[at] * width + u[at]).astype(int)
            density = np.linalg.det(to_frames[view]) / depth[at] ** 3 / model.area[pixel]
            weight = n_frames[view] * np.abs(density) * sharpness[row[at], column[at]] * step**2
            changes = np.concatenate([model.moves @ ideal[:, at], model.shared[:, :, pixel]])
            moved = slopes(views[view] @ ideal[:, at], views[view] @ changes).reshape(-1, 2, k + s)
            slope = right[row[at], column[at], None] * moved[:, 0] + down[row[at], column[at], None] * moved[:, 1]
            which = np.r_[view * k : view * k + k, n * k : n * k + s]
            total[np.ix_(which, which)] += slope.T @ (weight[:, None] * slope)
            weighted[np.ix_(at, which)] += weight[:, None] * slope
            weights[at] += weight
        weighted = weighted[weights > 0] / np.sqrt(weights[weights > 0, None])
        total -= weighted.T @ weighted
    return total


def joint_bound(
    scene: NDArray[Any], homographies: NDArray[np.float64], model: Model, step: int = 3, spacing: int | None = None
) -> Bound:
    """Return the bound on the motion of all frames.

    Args:
        scene: (Hs, Ws) flux.
        homographies: (T, 3, 3) true motion, ideal pixels of a frame to pixels of the scene.
        step: as in `information`.
        spacing: frames between nodes, by default what the motion allows.
    """
    spacing, n = spacing or spacing_of(homographies, model.frame_shape), len(homographies)
    n_views = round(n / min(VIEW_FRAMES, spacing / 2))
    instants = (np.arange(n_views) + 0.5) * n / n_views - 0.5
    k, s = len(model.moves), len(model.shared)
    spline = block_diag(np.kron(_spline(n, spacing, instants), np.eye(k)), np.eye(s))
    views = homographies[instants.round().astype(int)]
    of_views = information(scene, views, np.full(n_views, n / n_views), model, step)
    return Bound(*corner_errors_px(spline.T @ of_views @ spline, views, model, spline), spacing)


def corner_errors_px(
    of_unknowns: NDArray[np.float64], views: NDArray[np.float64], model: Model, spline: NDArray[np.float64] | None = None
) -> tuple[float, float, float]:
    """Return the mean, root mean square and worst corner error of views after alignment, given information on their motion.

    `spline` maps the unknowns to the numbers of each view, and to the shared ones; by default they are the same.
    """
    k, shape, n = len(model.moves), model.frame_shape, len(views)
    own, shared = model.corner_changes[:, :k], model.corner_changes[:, k:]
    moved = np.hstack([np.kron(np.eye(n), own), np.tile(shared, (n, 1))])
    moved = moved if spline is None else moved @ spline
    to_scene = views @ lens_at_corners(model.camera, shape)
    here = _homogeneous(corners(shape))
    by_plane = np.linalg.inv(to_scene)[:, None] @ generators(shape) @ to_scene[:, None] @ here
    planes = np.linalg.qr(slopes(np.broadcast_to(here, (n, 3, 4)), by_plane).reshape(-1, 8))[0]
    moved = moved - planes @ (planes.T @ moved)
    # Numbers in units of their own information, as they differ by many orders of magnitude.
    diagonal = np.diag(of_unknowns)
    unit = 1 / np.sqrt(np.maximum(diagonal, UNKNOWN * diagonal.max()))
    moved, known = moved * unit, of_unknowns * np.outer(unit, unit)
    moves = moved.T @ moved
    # A lens may move no corner, and the rest of the frame yet: what is known of it counts.
    sizes, directions = np.linalg.eigh(known + moves / np.linalg.norm(moves, 2))
    kept = directions[:, sizes > PLANE]
    values, axes = np.linalg.eigh(kept.T @ known @ kept)
    axes = kept @ axes / np.sqrt(np.maximum(values, UNKNOWN * values[-1]))
    errors = (moved @ axes).reshape(n, 4, 2, -1)
    narrow, wide = np.moveaxis(np.maximum(np.linalg.eigvalsh(errors @ errors.swapaxes(-1, -2)), 0), -1, 0)
    # The mean length of a Gaussian vector.
    mean = np.sqrt(2 * wide / np.pi) * ellipe(1 - narrow / wide)
    return float(mean.mean()), float(np.sqrt((narrow + wide).mean())), float(mean.mean(axis=1).max())


def spacing_of(homographies: NDArray[np.float64], frame_shape: tuple[int, int]) -> int:
    """Return the largest of `SPACINGS` at which a spline represents the corners of all frames within `TOLERANCE_PX`."""
    frames = np.arange(0, len(homographies), EVERY)
    there = transform_points(homographies[frames], corners(frame_shape)).reshape(len(frames), -1)
    for spacing in SPACINGS[:-1]:
        basis = _spline(len(homographies), spacing, frames)
        if np.abs(basis @ np.linalg.lstsq(basis, there, rcond=None)[0] - there).max() <= TOLERANCE_PX:
            return spacing
    return SPACINGS[-1]


def _spline(n_frames: int, spacing: int, instants: NDArray[Any]) -> NDArray[np.float64]:
    """Return the values of a cubic spline at instants by its values at nodes: (N, nodes)."""
    nodes = np.linspace(0, n_frames - 1, max(4, round(n_frames / spacing) + 1))
    return np.asarray(CubicSpline(nodes, np.eye(len(nodes)))(instants))
