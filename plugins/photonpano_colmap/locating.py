"""Locate exposures: find their patches in others, and adjust poses and points to these.

Patches are looked for where depth and poses predict them (Lucas and Kanade 1981). GTSAM does the bundle adjustment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import gtsam
import numpy as np
from gtsam.symbol_shorthand import C as CAMERA
from gtsam.symbol_shorthand import L as POINT
from gtsam.symbol_shorthand import X as POSE
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from photonpano import FloatArray
from photonpano.compiling import compiled
from photonpano.geometry import Camera, camera_matrix, positions_of
from photonpano.locating import view_of
from photonpano_colmap.exposures import Image, PosedExposure, posed, projected
from photonpano_colmap.reconstruction import without_gauge
from photonpano_poses import Lens, between, lens_of, sampled, seen_at

_BLUR_PX = 1.0  # standard deviation of the blur against photon noise
_HALF = 9  # patches have 19 x 19 pixels, with Gaussian weights
_BORDER = _HALF + 3
# Corners are at least 9 px apart, with at least this fraction of the strongest corner's curvature.
_APART_PX = 9
_QUALITY = 0.002
_STEPS = 15
_CONVERGED_PX = 0.01
_LARGEST_STEP_PX = 2.0
_LARGEST_SHIFT_PX = 8.0  # radius of the search around the predicted position
_LARGEST_CHI_SQUARE = 2.0  # maximum reduced chi-square of a patch
_LARGEST_STD_PX = 1.0  # maximum standard error of the position of a patch
_SLOPE_PX = 3.0  # standard deviation of the blur before slopes of the inverse depth are computed


class Stabilised(NamedTuple):
    """An exposure as an image of uniform noise."""

    image: Image  # (H, W), blurred; NaN where it is unknown
    noise: float  # variance of a pixel before the blur
    noise_left: float  # share of this variance that the blur leaves


class Patches(NamedTuple):
    """Patches of an exposure."""

    pixels: FloatArray  # (N, 2) their middles, px
    inverse_depth: FloatArray  # (N, 3) that of their middles, and its slopes along x and y per px


class Found(NamedTuple):
    """Where some patches are in another exposure."""

    patches: NDArray[np.intp]  # (M,) their numbers
    pixels: FloatArray  # (M, 2) px, ideal ones
    covariance: FloatArray  # (M, 2, 2) px^2, as photon noise has it


def stabilised(posed: PosedExposure) -> Stabilised:
    """Return an exposure as an image of uniform noise."""
    view = view_of(posed.exposure, _BLUR_PX)
    noise = float(np.median(1 / view.weight[view.seen])) if view.seen.any() else 1.0
    return Stabilised(np.where(view.seen, view.image, np.float32(np.nan)), noise, view.noise_left)


def patches_of(posed: PosedExposure, view: Stabilised, most: int) -> Patches:
    """Choose patches with structure along both axes, the strongest first (Shi and Tomasi 1994)."""
    known = np.isfinite(view.image)
    if not known.any():
        return Patches(np.zeros((0, 2)), np.zeros((0, 3)))
    filled = np.where(known, view.image, np.float32(np.median(view.image[known])))
    mask = cv2.erode(known.astype(np.uint8), np.ones((2 * _BORDER + 1, 2 * _BORDER + 1), np.uint8), borderValue=0)
    found = cv2.goodFeaturesToTrack(filled, most, _QUALITY, _APART_PX, mask=mask, blockSize=_HALF)
    if found is None:
        return Patches(np.zeros((0, 2)), np.zeros((0, 3)))
    pixels = found[:, 0].astype(np.float64)
    smooth = cv2.GaussianBlur(posed.inverse_depth, (0, 0), _SLOPE_PX)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=3, scale=1 / 8) for axes in ((1, 0), (0, 1))]
    columns, rows = np.rint(pixels.T).astype(int)
    at = np.stack([each[rows, columns] for each in (posed.inverse_depth, *slopes)], axis=1)
    return Patches(pixels, at.astype(np.float64))


def find_patches(
    patches: Patches, here: tuple[PosedExposure, Stabilised], there: tuple[PosedExposure, Stabilised], camera: Camera
) -> Found:
    """Find the patches of an exposure, `here`, in another one, `there`.

    The noise of the patch itself shifts it alike in all other exposures, and with it the point of the scene that it stands for.
    """
    (posed, view), (other, image) = here, there
    turn, shift = between(posed.pose, other.pose, camera.matrix)
    number = len(patches.pixels)
    pixels, hessian, chi_square = np.full((number, 2), np.nan), np.zeros((number, 2, 2)), np.full(number, np.inf)
    noise = view.noise + image.noise
    # Central differences of noise, which the blur has correlated.
    gradient_noise = 0.5 * (1 - np.exp(-1 / _BLUR_PX**2)) * image.noise * image.noise_left
    lens, middles, depth = lens_of(camera, posed.inverse_depth.shape), patches.pixels, patches.inverse_depth
    _find(view.image, image.image, middles, depth, lens, turn, shift, gradient_noise, pixels, hessian, chi_square)
    chi_square /= noise * view.noise_left
    determinant = np.linalg.det(hessian)
    kept = np.isfinite(pixels[:, 0]) & (chi_square < _LARGEST_CHI_SQUARE) & (determinant > 0) & (hessian[:, 0, 0] > 0)
    found = np.flatnonzero(kept)
    covariance = noise * np.linalg.inv(hessian[found])
    ideal = camera.ideal(pixels[found])
    by_pixel = np.stack([camera.ideal_shift(ideal, np.broadcast_to(axis, ideal.shape)) for axis in np.eye(2)], axis=2)
    certain = (np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]) < _LARGEST_STD_PX**2) & np.isfinite(ideal[:, 0])
    covariance = by_pixel @ covariance @ np.swapaxes(by_pixel, 1, 2)
    return Found(found[certain], ideal[certain], covariance[certain])


@compiled
def _find(  # noqa: PLR0913, PLR0917
    template: Image,
    image: Image,
    middles: FloatArray,
    inverse_depth: FloatArray,
    lens: Lens,
    turn: FloatArray,
    shift: FloatArray,
    gradient_noise: float,
    pixels: FloatArray,
    hessian: FloatArray,
    chi_square: FloatArray,
) -> None:
    """Find patches of a template, (H, W), in an image by Gauss-Newton steps; those that are lost stay NaN.

    `middles` are (N, 2) px, whole numbers; `turn` and `shift` are from `path.between`; `gradient_noise` is the variance of a
    gradient by noise. Writes the middles in the image, (N, 2), the weighted sums of products of gradients of the scene,
    (N, 2, 2), and the weighted mean square of the residuals less their mean, (N,).
    """
    size = (2 * _HALF + 1) ** 2
    values, us, vs, weights = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    along_x, along_y, residuals = np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(middles)):
        x, y = middles[k, 0], middles[k, 1]
        q, q_x, q_y = inverse_depth[k, 0], inverse_depth[k, 1], inverse_depth[k, 2]
        n, weight, known = 0, 0.0, True
        for j in range(-_HALF, _HALF + 1):
            for i in range(-_HALF, _HALF + 1):
                q_there = q + q_x * i + q_y * j
                ideal = lens.ideal[int(y) + j, int(x) + i]
                us[n], vs[n], depth = seen_at(lens, turn, shift, ideal[0], ideal[1], q_there)
                values[n] = sampled(template, x + i, y + j)
                known = known and depth > 0 and np.isfinite(values[n])
                weights[n] = np.exp(-(i * i + j * j) / (2 * (0.6 * _HALF) ** 2))
                weight += weights[n]
                n += 1
        if not known:
            continue
        u, v = 0.0, 0.0
        for _ in range(_STEPS):
            mean = 0.0
            for t in range(size):
                at_u, at_v = us[t] + u, vs[t] + v
                along_x[t] = 0.5 * (sampled(image, at_u + 1, at_v) - sampled(image, at_u - 1, at_v))
                along_y[t] = 0.5 * (sampled(image, at_u, at_v + 1) - sampled(image, at_u, at_v - 1))
                residuals[t] = sampled(image, at_u, at_v) - values[t]
                mean += weights[t] * residuals[t]
            mean /= weight
            xx, xy, yy, gx, gy, squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for t in range(size):
                residual = residuals[t] - mean
                xx += weights[t] * along_x[t] * along_x[t]
                xy += weights[t] * along_x[t] * along_y[t]
                yy += weights[t] * along_y[t] * along_y[t]
                gx += weights[t] * along_x[t] * residual
                gy += weights[t] * along_y[t] * residual
                squares += weights[t] * residual * residual
            determinant = xx * yy - xy * xy
            if not determinant > 0:
                break
            step_u, step_v = (xy * gy - yy * gx) / determinant, (xy * gx - xx * gy) / determinant
            length = np.sqrt(step_u * step_u + step_v * step_v)
            shorter = min(1.0, _LARGEST_STEP_PX / max(length, 1e-12))
            u += shorter * step_u
            v += shorter * step_v
            if not u * u + v * v < _LARGEST_SHIFT_PX**2:
                break
            if length < _CONVERGED_PX:
                middle = size // 2
                pixels[k, 0], pixels[k, 1] = us[middle] + u, vs[middle] + v
                hessian[k, 0, 0], hessian[k, 1, 1] = xx - weight * gradient_noise, yy - weight * gradient_noise
                hessian[k, 0, 1] = hessian[k, 1, 0] = xy
                chi_square[k] = squares / weight
                break


_ROBUST = 2.0  # scale of the Cauchy loss, in standard deviations
_FLOOR_PX = 0.02  # error of observations beside photon noise, from interpolation and errors of depth
# Prior standard deviation of poses: in radians, and in mean distances of the cameras from their centroid.
_PRIOR_RAD, _PRIOR_SHIFT = 0.02, 0.2
_PRIOR_POINT = 100.0  # the same for points, whose depth may be undetermined, in those mean distances
_OUTLIER = 3.0  # standard deviations within which an observation confirms its point
# Prior standard deviation of what is given of the camera, in focal lengths and as it is; a wide one of what is found.
_HELD, _FREE = 1e-6, 0.5
_SHORTEST = 0.1  # of a focal length that is found, over that before: a scene that has none may lead below 0
_SEEN_BY = 3  # fewest exposures that confirm a point
_MOST_STEPS = 30
_REWEIGHTINGS = 3  # solutions; after each, observations are weighted by the residuals of their point
_MEDIAN_OF_TWO = float(chi2.median(2))  # of the squared norm of two standard normal numbers
_SHARED_PX = 6.0  # patches nearer to each other share most of their photons
_FAR_PX = 1e3  # residual of a point behind a camera


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Points that exposures see."""

    points: NDArray[np.intp]  # (M,) numbers of the points
    views: NDArray[np.intp]  # (M,) numbers of the exposures
    pixels: FloatArray  # (M, 2) px, ideal ones
    covariance: FloatArray  # (M, 2, 2) px^2, up to a common factor

    def kept(self, which: NDArray[np.bool_]) -> Observations:
        """Return some of the observations."""
        return Observations(self.points[which], self.views[which], self.pixels[which], self.covariance[which])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Adjusted:
    """Poses and points that agree best with all observations."""

    poses: FloatArray  # (V, 3, 4)
    points: FloatArray  # (N, 3)
    confirmed: NDArray[np.bool_]  # (N,) points that at least 3 exposures see where they should be
    # (V, 6, 6) of each pose while the others rest: a rotation vector of the camera, and a shift in the world
    information: FloatArray
    std_position: FloatArray  # (V,) expected distance of a camera from its true place, after the best alignment of all
    std_rotation: FloatArray  # (V,) expected angle in radians, after that alignment
    focal_px: float
    std_focal_px: float  # 0 if it was given
    missed_k1: float  # the distortion k1 that observations show beyond that of the lens, to first order
    std_k1: float
    residual_px: float  # median distance of an observation from where its point is seen
    excess: float  # that in standard deviations, relative to what is expected


def adjust(poses: FloatArray, points: FloatArray, observations: Observations, camera: Camera, finds_focal: bool) -> Adjusted:
    """Solve for the poses (V, 3, 4) and points (N, 3), each observed twice or more, that agree best with the observations.

    `finds_focal`: whether to solve for the focal length, too.
    """
    settings = gtsam.LevenbergMarquardtParams()
    settings.setMaxIterations(_MOST_STEPS)
    settings.setRelativeErrorTol(1e-4)
    expected, shared = observations.covariance + _FLOOR_PX**2 * np.eye(2), _shared(observations)
    covariance = expected
    for _ in range(_REWEIGHTINGS):
        graph, values = _problem(
            poses, points, observations, covariance=covariance * shared[:, None, None], camera=camera, finds_focal=finds_focal
        )
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
        if finds_focal:
            focal_px = max(values.atCal3Bundler(CAMERA(0)).fx(), _SHORTEST * camera.focal_px)
            camera = Camera(camera_matrix(focal_px, camera.centre_px))
        found = [values.atPose3(POSE(view)) for view in range(len(poses))]
        poses = posed(
            np.array([each.rotation().matrix().T for each in found]), np.array([each.translation() for each in found])
        )
        points = np.array([values.atPoint3(POINT(point)) for point in range(len(points))])
        residuals = observations.pixels - projected(poses[observations.views], points[observations.points], camera.matrix)
        residuals = np.where(np.isfinite(residuals), residuals, _FAR_PX)
        squares = np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(covariance), residuals)
        # Patches at the edges of things show two depths, and wander between them.
        of_point = _median_by(observations.points, squares, len(points)) / _MEDIAN_OF_TWO
        covariance = covariance * of_point[observations.points, None, None] + _FLOOR_PX**2 * np.eye(2)
    fits = squares < _OUTLIER**2 * of_point[observations.points]
    confirmed = np.bincount(observations.points[fits], minlength=len(points)) >= _SEEN_BY
    information, gradient = _information(graph, values, poses, len(points))
    size = 6 * len(poses)
    of_views = information[:size, :size].reshape(len(poses), 6, len(poses), 6)[np.arange(len(poses)), :, np.arange(len(poses))]
    last = size + finds_focal
    variances = np.diag(without_gauge(information[:last, :last], poses))
    turned, moved = variances[:size].reshape(len(poses), 2, 3).sum(axis=2).T
    with_k1 = np.append(np.arange(last), size + 1)
    of_k1 = np.linalg.inv(information[np.ix_(with_k1, with_k1)])[-1]
    return Adjusted(
        poses=poses,
        points=points,
        confirmed=confirmed,
        information=of_views,
        std_position=np.sqrt(moved),
        std_rotation=np.sqrt(turned),
        focal_px=camera.focal_px,
        std_focal_px=float(np.sqrt(variances[size])) if finds_focal else 0.0,
        missed_k1=float(of_k1 @ gradient[with_k1]),
        std_k1=float(np.sqrt(of_k1[-1])),
        residual_px=float(np.median(np.linalg.norm(residuals, axis=1))),
        excess=float(
            np.sqrt(np.median(np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(expected), residuals)) / _MEDIAN_OF_TWO)
        ),
    )


def _problem(
    poses: FloatArray,
    points: FloatArray,
    observations: Observations,
    *,
    covariance: FloatArray,
    camera: Camera,
    finds_focal: bool,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the factors of a bundle adjustment, the prior of the camera last, and the values that it begins with."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    calibration = gtsam.Cal3Bundler(camera.focal_px, 0.0, 0.0, *camera.centre_px)
    values.insert(CAMERA(0), calibration)
    centres = positions_of(poses)
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean())
    nearby = gtsam.noiseModel.Diagonal.Sigmas(np.array(3 * [_PRIOR_RAD] + 3 * [_PRIOR_SHIFT * spread]))
    for view, (pose, centre) in enumerate(zip(poses, centres, strict=True)):
        start = gtsam.Pose3(gtsam.Rot3(pose[:, :3].T), centre)
        values.insert(POSE(view), start)
        graph.add(gtsam.PriorFactorPose3(POSE(view), start, nearby))
    somewhere = gtsam.noiseModel.Isotropic.Sigma(3, _PRIOR_POINT * spread)
    for point, place in enumerate(points):
        values.insert(POINT(point), place)
        graph.add(gtsam.PriorFactorPoint3(POINT(point), place, somewhere))
    robust = gtsam.noiseModel.mEstimator.Cauchy.Create(_ROBUST)
    rows = zip(observations.points, observations.views, observations.pixels, np.linalg.inv(covariance), strict=True)
    for point, view, pixel, information in rows:
        noise = gtsam.noiseModel.Robust.Create(robust, gtsam.noiseModel.Gaussian.Information(information))
        graph.add(gtsam.GeneralSFMFactor2Cal3Bundler(pixel, noise, POSE(int(view)), POINT(int(point)), CAMERA(0)))
    stds = np.array([camera.focal_px * (_FREE if finds_focal else _HELD), _HELD, _HELD])
    graph.add(gtsam.PriorFactorCal3Bundler(CAMERA(0), calibration, gtsam.noiseModel.Diagonal.Sigmas(stds)))
    return graph, values


def _information(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, poses: FloatArray, n_points: int
) -> tuple[FloatArray, FloatArray]:
    """Return the information of poses, focal length, k1 and k2, whatever the points, (6 V + 3, 6 V + 3), and the gradient.

    It is that of observations, without the prior of the camera; see the convention of `pose_noise`.
    """
    n_views = len(poses)
    graph.resize(graph.size() - 1)
    order = gtsam.Ordering()
    for point in range(n_points):
        order.push_back(POINT(point))
    _, of_poses = graph.linearize(values).eliminatePartialMultifrontal(order)
    order = gtsam.Ordering()
    for view in range(n_views):
        order.push_back(POSE(view))
    order.push_back(CAMERA(0))
    information, gradient = of_poses.hessian(order)
    # GTSAM perturbs the camera in the world by (w, t) in its own axes: R exp(-w), and a shift by R^T t.
    to_own = np.eye(len(information))
    for view, rotation in enumerate(poses[:, :, :3]):
        turn, move = slice(6 * view, 6 * view + 3), slice(6 * view + 3, 6 * view + 6)
        to_own[turn, turn], to_own[move, move] = -np.eye(3), rotation
    return np.asarray(to_own.T @ information @ to_own), np.asarray(to_own.T @ gradient)


def _shared(observations: Observations) -> FloatArray:
    """Return how many observations share the photons of each, since points of several key exposures coincide: (M,)."""
    shared = np.ones(len(observations.points))
    for view in np.unique(observations.views):
        of_view = np.flatnonzero(observations.views == view)
        pixels = observations.pixels[of_view]
        shared[of_view] = cKDTree(pixels).query_ball_point(pixels, _SHARED_PX, return_length=True)
    return shared


def _median_by(group: NDArray[np.intp], values: FloatArray, number: int) -> FloatArray:
    """Return the medians of the values of each group: (number,)."""
    order = np.lexsort((values, group))
    counts = np.bincount(group, minlength=number)
    middle = np.cumsum(counts) - counts + counts // 2
    return np.asarray(values[order][np.minimum(middle, len(values) - 1)])
