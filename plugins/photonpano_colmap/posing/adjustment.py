"""Bundle adjustment of exposures and points, by GTSAM."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C as CAMERA
from gtsam.symbol_shorthand import L as POINT
from gtsam.symbol_shorthand import X as POSE
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from photonpano import FloatArray
from photonpano.geometry import Camera, camera_matrix, positions_of
from photonpano_colmap.pose_noise import without_gauge
from photonpano_colmap.posing.path import posed, projected

_ROBUST = 2.0  # scale of the Cauchy loss, in standard deviations
_FLOOR_PX = 0.02  # error of observations beside photon noise, from interpolation and errors of depth
# Prior standard deviation of poses: in radians, and in mean distances of the cameras from their centroid.
_PRIOR_RAD, _PRIOR_SHIFT = 0.02, 0.2
_PRIOR_POINT = 100.0  # the same for points, whose depth may be undetermined, in those mean distances
_OUTLIER = 3.0  # standard deviations within which an observation confirms its point
# Prior standard deviation of what is given of the camera, in focal lengths and as it is; a wide one of what is found.
_HELD, _FREE = 1e-6, 0.5
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


@dataclass(frozen=True, slots=True, eq=False)
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
        graph, values = _problem(poses, points, observations, covariance * shared[:, None, None], camera, finds_focal)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
        if finds_focal:
            camera = Camera(camera_matrix(values.atCal3Bundler(CAMERA(0)).fx(), camera.centre_px))
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
        poses,
        points,
        confirmed,
        of_views,
        np.sqrt(moved),
        np.sqrt(turned),
        camera.focal_px,
        float(np.sqrt(variances[size])) if finds_focal else 0.0,
        float(of_k1 @ gradient[with_k1]),
        float(np.sqrt(of_k1[-1])),
        float(np.median(np.linalg.norm(residuals, axis=1))),
        float(np.sqrt(np.median(np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(expected), residuals)) / _MEDIAN_OF_TWO)),
    )


def _problem(
    poses: FloatArray,
    points: FloatArray,
    observations: Observations,
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
