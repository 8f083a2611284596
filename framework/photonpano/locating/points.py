"""From matched points to an accepted motion: consensus and least squares, the last steps of keypoint locators.

A camera that only turns has three parameters, which matches determine where they do not determine the eight of a homography.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from photonpano.geometry import (
    ROTATION_AXES,
    Camera,
    corners,
    from_parameters,
    jacobian,
    nearest_rotations,
    normalised,
    parameters,
    rotation_matrices,
    transform_points,
    why_implausible,
)
from photonpano.locating.configs import MatchingConfig, PointLimits
from photonpano.robust import robust_std, soft_l1_weights
from photonpano.values import BoolArray, FloatArray, Homography, Located, NotLocated

# Expected error of a corner in the directions that a turn does not reach, in sides of the image: as good as unknown.
_UNKNOWN = 1.0


class TurnInformation(NamedTuple):
    """Information of a pair of exposures on the rotation between them."""

    # (8, 8) inverse covariance of p1..p8 of the homography. Only a turn is known: what else could have happened to the image is
    # uncertain by a whole image.
    information: FloatArray
    std_px: float  # expected error of a corner if the camera has only turned


def turn_slopes(homography: Homography, camera_matrix: FloatArray) -> FloatArray:
    """Return the derivatives of p1..p8 of a homography by a rotation vector of the camera whose pixels it maps: (8, 3).

    The homography H has h33 = 1. With the camera matrix K, a small rotation R before it makes it H K R K^-1.
    """
    changes = homography @ camera_matrix @ ROTATION_AXES @ np.linalg.inv(camera_matrix)
    return np.asarray(parameters(changes - changes[:, 2:, 2:] * homography + np.eye(3)).T)


def information_on_turn(
    information: FloatArray, homography: Homography, camera_matrix: FloatArray, shape: tuple[int, int]
) -> TurnInformation:
    """Restrict information on a homography to the three unknowns of a turn, at the turn that fits the exposures best.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Args:
        information: (8, 8) inverse covariance of p1..p8, as if all were estimated.
        homography: (3, 3) K R K^-1, scaled to h33 = 1.
        camera_matrix: (3, 3) K, in px of the images.
        shape: (height, width) of the images.

    Raises:
        numpy.linalg.LinAlgError: the images do not determine a turn.
    """
    basis, to_corners = turn_slopes(homography, camera_matrix), jacobian(homography, corners(shape)).reshape(8, 8)
    rows = information @ basis
    covariance = np.linalg.inv(basis.T @ rows)
    weak = to_corners.T @ to_corners / (_UNKNOWN * max(shape)) ** 2
    moves = to_corners @ basis
    return TurnInformation(rows @ covariance @ rows.T + weak, float(np.sqrt(np.trace(moves @ covariance @ moves.T) / 4)))


Points = NDArray[np.floating]
# Rounds of reweighting; after 4 the weights of the soft L1 loss change the result by a few per cent of its error.
_REWEIGHTINGS = 4
# Lower bound of the position error of a keypoint, px; the residuals of a few matches may be smaller by chance.
MIN_NOISE_PX = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Matched points of two images."""

    moving: Points  # (N, 2) points of the moving image; integers are pixel centres
    fixed: Points  # (N, 2) their partners
    guided: bool  # whether partners were searched near the position that a motion predicts, and not in the whole image
    sizes: Points | None = None  # (N,) diameters of the keypoints, None if all are equal


def consensus_of(
    attempts: Iterable[Matches],
    estimate: Callable[[Points, Points], Homography | None],
    limits: PointLimits,
    evidence: Mapping[str, float],
) -> tuple[Matches, Homography, dict[str, float]] | NotLocated:
    """Return the first matches that agree on a homography beyond chance, the homography, and the evidence. Raises nothing.

    Args:
        attempts: at least one set of matches; a later one is computed only if those before it fail.
        estimate: robust estimator such as RANSAC: from (N, 2) moving and fixed points to a (3, 3) homography of any scale, or
            None.
        limits: thresholds of acceptance.
        evidence: counts of the backend. `matches` and `agreeing` are added.

    Returns:
        `NotLocated` with the reason why the last matches fail if all of them do.
    """
    for matches in attempts:
        count = len(matches.moving)
        found = {**evidence, "matches": float(count)}
        if count < limits.min_inliers:
            failure = too_few_matches(count, limits, found)
            continue
        homography, agreeing = estimate(matches.moving, matches.fixed), 0
        if homography is not None:
            distances = np.linalg.norm(transform_points(homography, matches.moving) - matches.fixed, axis=1)
            # Keypoints of blurred and dark exposures scatter more, and in the whole image fewer matches agree by chance.
            agreeing = int(np.count_nonzero(distances < limits.threshold_px * (1 if matches.guided else 2)))
        found["agreeing"] = float(agreeing)
        # In the form of Brown and Lowe (2007, section 3.2). Near a predicted position keypoints of pure noise match as well: 10
        # to 16 % of them agree, and 60 % and more do for a scene at 0.01 photons per pixel per frame. In the whole image next
        # to none agree by chance, but of matches between blurred exposures few agree to a pixel or two even if the motion is
        # right.
        by_chance = 8.0 + (0.3 if matches.guided else 0.1) * count
        if homography is not None and agreeing > by_chance:
            return matches, normalised(homography), found
        failure = NotLocated(
            f"{agreeing} of {count} matches agree on a motion, which may be chance (more than {by_chance:.0f} must)", found
        )
    return failure


def too_few_matches(count: int, limits: PointLimits, evidence: Mapping[str, float]) -> NotLocated:
    """Return that there are fewer matches than `min_inliers`, with the numbers of keypoints if `evidence` has them."""
    keypoints = ""
    if "keypoints_moving" in evidence:
        keypoints = f" ({evidence['keypoints_moving']:.0f} and {evidence['keypoints_fixed']:.0f} keypoints)"
    return NotLocated(f"{count} matches, fewer than min_inliers = {limits.min_inliers}{keypoints}", evidence)


def motion_from_points(  # noqa: PLR0913
    moving: Points,
    fixed: Points,
    start: Homography,
    shape: tuple[int, int],
    limits: PointLimits,
    *,
    sizes: Points | None = None,
    evidence: Mapping[str, float] | None = None,
    rounds: int = 2,
    rounding_px: float = 0.0,
) -> Located | NotLocated:
    """Fit a motion to its inliers by least squares, and accept or reject it. Raises nothing.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Args:
        moving: (N, 2) points of the moving image.
        fixed: (N, 2) their partners.
        start: (3, 3) initial motion from a robust estimator such as RANSAC.
        shape: (height, width) of both images.
        limits: thresholds of acceptance.
        sizes: (N,) diameters of the keypoints, None if all are equal; position errors are proportional to them.
        evidence: counts of the backend, for the record.
        rounds: how often inliers are selected and fitted.
        rounding_px: standard deviation of an error common to all matches, as where keypoints lie on whole pixels.

    Returns:
        `Located` with the information from the residuals, `evidence`, and the numbers of `matches` and `inliers`;
        `NotLocated` if there are too few inliers, if they leave the corners of the frame uncertain, or if no camera moves like
        that.
    """
    found = dict(evidence or {})
    found.setdefault("matches", float(len(moving)))
    if reason := why_implausible(start, shape):
        return NotLocated(f"{reason}, from {len(moving)} matches", found)
    sizes = np.ones(len(moving)) if sizes is None else sizes
    homography = start
    for _ in range(rounds):
        inliers = np.linalg.norm(transform_points(homography, moving) - fixed, axis=1) <= limits.threshold_px
        found["inliers"] = float(np.count_nonzero(inliers))
        if found["inliers"] < limits.min_inliers:
            return NotLocated(
                f"{found['inliers']:.0f} of {len(moving)} matches lie within {limits.threshold_px:g} px of the motion, "
                f"fewer than min_inliers = {limits.min_inliers}",
                found,
            )
        fit = fit_homography(moving[inliers], fixed[inliers], sizes[inliers], homography, rounding_px)
        homography = fit.homography
    std_px = fit.corner_std_px(shape)
    if not std_px <= limits.max_std_px:
        return NotLocated(
            f"{found['inliers']:.0f} inliers leave the corners of the frame uncertain by {std_px:.1f} px, "
            f"more than max_std_px = {limits.max_std_px:g}",
            found,
        )
    if reason := why_implausible(homography, shape):
        return NotLocated(f"{reason}, from {found['inliers']:.0f} inliers", found)
    return Located(homography, fit.information, fit.residual_px, found)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A homography fitted to matches."""

    homography: Homography  # (3, 3), moving to fixed
    information: FloatArray  # (8, 8) inverse covariance of p1..p8
    residual_px: float  # standard deviation of a coordinate of a keypoint of median size, in px

    def corner_std_px(self, shape: tuple[int, int]) -> float:
        """Return the largest expected error of a corner of the frame, in px; infinite if the fit is degenerate."""
        to_corners = jacobian(self.homography, corners(shape)).reshape(8, 8)
        try:
            covariance = to_corners @ np.linalg.inv(self.information) @ to_corners.T
        except np.linalg.LinAlgError:
            return np.inf
        variances = np.diag(covariance).reshape(4, 2).sum(axis=1)
        return float(np.sqrt(variances.max())) if np.all(variances >= 0) else np.inf


def fit_homography(
    moving: NDArray[np.floating],
    fixed: NDArray[np.floating],
    sizes: NDArray[np.floating],
    start: Homography,
    rounding_px: float = 0.0,
) -> Fit:
    """Fit a homography to matches by robust least squares, weighted by the inverse sizes of the keypoints.

    Position errors of the (N, 2) points are proportional to the (N,) diameters of the keypoints. `rounding_px` is the standard
    deviation of an error common to all matches: keypoints on whole pixels are all rounded alike where the camera only shifts.
    """
    here, there = moving.astype(np.float64), fixed.astype(np.float64)
    by_size = (np.median(sizes) / sizes).astype(np.float64)
    p = parameters(start)
    residuals = _residuals(p, here, there, by_size)
    # Iteratively reweighted: scipy's robust losses need a decomposition that takes a hundred times as long.
    for _ in range(_REWEIGHTINGS):
        lengths = np.linalg.norm(residuals.reshape(-1, 2), axis=1)
        weights = by_size * np.sqrt(soft_l1_weights(lengths, max(robust_std(residuals), MIN_NOISE_PX)))
        solution = least_squares(_residuals, p, _derivatives, method="lm", x_scale="jac", args=(here, there, weights))
        p = solution.x
        residuals = _residuals(p, here, there, by_size)
    # The RMS, since the median ignores the tails: with it, squared errors of motions from SIFT are three times as large as the
    # information predicts; with the RMS they agree.
    spread = max(np.sqrt(np.sum(residuals**2) / max(1, len(residuals) - len(p))), MIN_NOISE_PX)
    j = _derivatives(p, here, there, by_size)
    information = j.T @ j / spread**2
    if rounding_px:
        shifts = np.diag([0, 0, 0, 0, rounding_px**2, rounding_px**2, 0, 0])
        # (information^-1 + shifts)^-1, without the inverse of an information that may be singular.
        information = information @ np.linalg.inv(np.eye(len(p)) + shifts @ information)
    return Fit(from_parameters(p), information, float(spread))


def _residuals(p: FloatArray, here: FloatArray, there: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the weighted residuals along x and y: (2 N,)."""
    return ((transform_points(from_parameters(p), here) - there) * weights[:, None]).ravel()


def _derivatives(p: FloatArray, here: FloatArray, there: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the derivatives of the residuals: (2 N, 8)."""
    del there
    return (jacobian(from_parameters(p), here) * weights[:, None, None]).reshape(-1, 8)


_SCATTER = 2.0  # keypoints of dark exposures scatter: a match agrees with a rotation within this many `threshold_px`
_LEAST_SHARE = 0.2
# Similar objects match and agree in different scenes, too. So a minimum share of the matches must agree, and their standard
# deviation in every direction must be a minimum share of the shorter side of the image.
_LEAST_SPREAD = 0.1
_ITERATIONS = 10  # steps of reweighted least squares; the last ones change the rotation by far less than its error
# Pairs of matches that are tried at most; of more, as many are drawn, 200 of them right if a fifth of the matches are.
_MOST_PAIRS = 5000
_MOST_SCORED = 500_000  # rotations are scored until they have mapped this many points
_BASELINE = 10.0  # two matches determine a rotation if they are further apart than this, in units of the threshold
_ROUNDS = 3  # how often the best rotation is fitted to the matches that agree with it
# Expected number of rotations, of all that two matches determine, on which as many matches agree by chance.
_FALSE_ALARMS = 1e-4
_FAR_PX = 1e6  # points that are mapped further away are taken to lie there


def turn_of(  # noqa: PLR0917
    attempts: Iterable[Matches],
    shape: tuple[int, int],
    limits: MatchingConfig,
    camera_matrix: FloatArray,
    evidence: Mapping[str, float] | None = None,
    rounding_px: float = 0.0,
) -> Located | NotLocated:
    """Return the rotation on which the first matches agree beyond chance, fitted to them. Raises nothing.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Args:
        attempts: at least one set of matches; a later one is computed only if those before it fail.
        shape: (height, width) of both images.
        limits: thresholds of acceptance. A rotation needs three eighths of `min_inliers`, which a homography needs.
        camera_matrix: (3, 3) K, in px of the images; the lens does not distort.
        evidence: counts of the backend, for the record.
        rounding_px: standard deviation of an error common to all matches, as where keypoints lie on whole pixels.

    Returns:
        `Located` with K R K^-1 of the rotation R, information on its three unknowns alone, and the evidence
        `degrees_of_freedom` 3; `NotLocated` with the reason why the last matches fail if all of them do.
    """
    for matches in attempts:
        motion = _turn(
            matches, shape, limits, camera=Camera(camera_matrix), found=dict(evidence or {}), rounding_px=rounding_px
        )
        if isinstance(motion, Located):
            break
    return motion


def _turn(
    matches: Matches,
    shape: tuple[int, int],
    limits: MatchingConfig,
    *,
    camera: Camera,
    found: dict[str, float],
    rounding_px: float,
) -> Located | NotLocated:
    """Return the rotation on which some matches agree; see `turn_of`. The evidence is added to `found`."""
    threshold_px = _SCATTER * limits.threshold_px
    moving, fixed = (np.asarray(each, np.float64) for each in (matches.moving, matches.fixed))
    kept = distinct(moving, fixed, threshold_px)
    moving, fixed, count = moving[kept], fixed[kept], int(kept.sum())
    found |= {"matches": float(count), "degrees_of_freedom": 3.0}
    least = max(5, math.ceil(limits.min_inliers * 3 / 8))
    if count < least:
        return NotLocated(f"{count} matches, and a rotation needs {least}", found)
    start = rotation_of_most(moving, fixed, camera, threshold_px)
    if start is None:
        return NotLocated(f"no rotation agrees with any of {count} matches", found)
    if reason := why_implausible(start, shape):
        return NotLocated(f"{reason}, from {count} matches", found)
    fit = _fit(moving, fixed, normalised(start), camera, threshold_px)
    inliers = int(np.count_nonzero(fit.agrees))
    found["inliers"] = float(inliers)
    search_px = limits.search_px if matches.guided else np.inf
    by_chance = agreeing_by_chance(moving, fixed, fit.homography, threshold_px, search_px)
    by_chance = max(by_chance, math.floor(_LEAST_SHARE * count), least - 1)
    if inliers <= by_chance:
        return NotLocated(f"{inliers} of {count} matches agree, which may be chance (more than {by_chance} must)", found)
    spread_px = math.sqrt(max(0.0, float(np.linalg.eigvalsh(np.cov(moving[fit.agrees].T))[0])))
    if spread_px < _LEAST_SPREAD * min(shape):
        return NotLocated(
            f"{inliers} matches agree, but lie in a spot or strip of {spread_px:.0f} px "
            f"(at least {_LEAST_SPREAD * min(shape):.0f} px are needed)",
            found,
        )
    try:
        information, std_px = information_on_turn(fit.information, fit.homography, camera.matrix, shape)
    except np.linalg.LinAlgError:
        information, std_px = fit.information, np.inf
    if not std_px <= limits.max_std_px:
        return NotLocated(
            f"{inliers} matches leave the corners of the frame uncertain by {std_px:.1f} px, "
            f"more than max_std_px = {limits.max_std_px:g}",
            found,
        )
    if reason := why_implausible(fit.homography, shape):
        return NotLocated(f"{reason}, from {inliers} matches", found)
    # (information^-1 + shifts)^-1: a common error of all matches shifts the motion.
    shifts = np.diag([0, 0, 0, 0, rounding_px**2, rounding_px**2, 0, 0])
    information = information @ np.linalg.inv(np.eye(8) + shifts @ information)
    return Located(fit.homography, information, fit.residual_px, found)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """A rotation fitted to matches."""

    homography: Homography  # (3, 3), moving to fixed
    agrees: BoolArray  # (N,) which matches agree
    residual_px: float  # standard deviation of a coordinate of their residuals, in px
    information: FloatArray  # (8, 8) inverse covariance of p1..p8, as if all were estimated


def _fit(moving: FloatArray, fixed: FloatArray, start: Homography, camera: Camera, threshold_px: float) -> _Fit:
    """Fit a rotation to the matches, (N, 2) points and partners, that agree with it, by least squares with the soft L1 loss."""
    homography = start
    for _ in range(_ITERATIONS):
        agrees, residuals, scale = _residuals_of_turn(moving, fixed, homography, threshold_px)
        root = np.sqrt(soft_l1_weights(np.linalg.norm(residuals, axis=1), scale))[:, None]
        slopes = jacobian(homography, moving[agrees]) @ turn_slopes(homography, camera.matrix)
        step = np.linalg.lstsq((slopes * root[..., None]).reshape(-1, 3), -(residuals * root).ravel(), rcond=None)[0]
        homography = normalised(homography @ camera.homographies(rotation_matrices(step)))
    agrees, residuals, scale = _residuals_of_turn(moving, fixed, homography, threshold_px)
    slopes = jacobian(homography, moving[agrees]).reshape(-1, 8)
    residual_px = float(np.sqrt((residuals**2).sum() / max(1, residuals.size - 3)))
    each = _information(np.linalg.norm(transform_points(homography, moving) - fixed, axis=1), scale, threshold_px)
    return _Fit(homography, agrees, residual_px, slopes.T @ slopes * each)


def _residuals_of_turn(
    moving: FloatArray, fixed: FloatArray, homography: Homography, threshold_px: float
) -> tuple[BoolArray, FloatArray, float]:
    """Return which matches agree, their (M, 2) residuals, and the robust standard deviation of these."""
    residuals = transform_points(homography, moving) - fixed
    agrees = np.linalg.norm(residuals, axis=1) < threshold_px
    residuals = residuals[agrees]
    return agrees, residuals, max(robust_std(residuals), MIN_NOISE_PX)


def _information(lengths: FloatArray, scale: float, threshold_px: float) -> float:
    """Return the information of a match on each coordinate of its position, in px^-2: that of an M-estimator (Huber 1981).

    A match beyond the threshold has no influence. So a shift of the fit gains matches on one side and loses them on the other,
    which cancels the information of the others where matches are spread evenly, as chance spreads them. `lengths` are those of
    the residuals of all matches, the same in all directions; `scale` is that of the loss.
    """
    inner = lengths[lengths < threshold_px]
    if not len(inner):
        return 0.0
    # The ring has the area of the circle within the threshold. One match more keeps few matches from seeming exact.
    ring = 1 + np.count_nonzero((lengths > threshold_px * np.sqrt(0.5)) & (lengths < threshold_px * np.sqrt(1.5)))
    weights = soft_l1_weights(inner, scale)
    slope = (weights - weights**3 * (inner / scale) ** 2 / 2).sum() - ring / np.sqrt(1 + (threshold_px / scale) ** 2)
    square = ((weights * inner) ** 2 + MIN_NOISE_PX**2).sum() / max(1, 2 * len(inner) - 3)
    return float(max(slope, 0.0) / len(inner)) ** 2 / float(square)


def distinct(moving: FloatArray, fixed: FloatArray, threshold_px: float) -> BoolArray:
    """Return which of N matches are not the same as an earlier one, within a threshold in both images: (N,).

    A structure that is detected at several sizes or orientations matches several times, and then agrees with itself.
    """
    kept = np.ones(len(moving), dtype=bool)
    near = cKDTree(np.concatenate([moving, fixed], axis=1)).query_pairs(threshold_px, output_type="ndarray")
    kept[near.max(axis=1, initial=0)] = False
    kept[:1] = True
    return kept


def rotation_of_most(moving: FloatArray, fixed: FloatArray, camera: Camera, threshold_px: float) -> Homography | None:
    """Return the homography K R K^-1 of the rotation R on which most matches agree; None if no two of them determine one.

    Every two matches determine a rotation. Those of all pairs, or of a sample, are scored by the squared distances that they
    leave, each at most that of the threshold; the best is fitted to the matches that agree with it. Points are (N, 2) in px of
    images without distortion.
    """
    rays, partners = camera.directions(moving), camera.directions(fixed)
    first, second = _pairs(len(moving))
    here, there = (np.linalg.norm(each[first] - each[second], axis=1) * camera.focal_px for each in (rays, partners))
    chosen = (np.abs(here - there) < 2 * threshold_px) & (np.minimum(here, there) > _BASELINE * threshold_px)
    first, second = first[chosen], second[chosen]
    if not len(first):
        return None
    first, second = (each[: max(1, _MOST_SCORED // len(moving))] for each in (first, second))
    rotations = _frames(partners[first], partners[second]) @ np.swapaxes(_frames(rays[first], rays[second]), -1, -2)

    def squares(rotations: FloatArray) -> FloatArray:
        left = np.square(transform_points(camera.homographies(rotations), moving) - fixed).sum(axis=-1)
        return np.asarray(np.fmin(left, threshold_px**2))

    costs = squares(rotations).sum(axis=1)
    best, cost = rotations[costs.argmin()], costs.min()
    for _ in range(_ROUNDS):
        agrees = squares(best) < threshold_px**2
        refined = nearest_rotations(partners[agrees].T @ rays[agrees])
        if (left := squares(refined).sum()) >= cost:
            break
        best, cost = refined, left
    return camera.homographies(best)


def agreeing_by_chance(
    moving: FloatArray, fixed: FloatArray, homography: Homography, threshold_px: float, search_px: float
) -> int:
    """Return the largest number of matches, (N, 2) points and partners, that may agree on a rotation by chance.

    This is an a-contrario test (Moisan and Stival 2004). Two of N matches determine a rotation; each other one agrees with it
    by chance with a probability p. More than the number returned do so for `_FALSE_ALARMS` of all N (N - 1) / 2 rotations on
    average. Where partners are searched within a radius, p is the share of its area. If that is infinite, for the whole image,
    p is the share of matches that would agree if they exchanged their partners; it is large where keypoints cluster.
    """
    count = len(moving)
    if np.isfinite(search_px):
        share = min(1.0, (threshold_px / search_px) ** 2)
    else:
        mapped = np.clip(np.nan_to_num(transform_points(homography, moving)), -_FAR_PX, _FAR_PX)
        near = cKDTree(mapped).sparse_distance_matrix(cKDTree(fixed), threshold_px, output_type="ndarray")
        exchanged = int(np.count_nonzero(near["i"] != near["j"]))
        share = max(exchanged, 1) / (count * (count - 1))
    others = np.arange(count - 1)
    tail = bdtrc(others, count - 2, share) * count * (count - 1) / 2
    return int(others[tail < _FALSE_ALARMS][0]) + 2


def _pairs(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of different indices below a number, in random order: all, or `_MOST_PAIRS`."""
    rng = np.random.default_rng(0)
    if count * (count - 1) // 2 <= _MOST_PAIRS:
        first, second = np.triu_indices(count, 1)
        order = rng.permutation(len(first))
        return first[order], second[order]
    first = rng.integers(count, size=_MOST_PAIRS)
    return first, (first + rng.integers(1, count, size=_MOST_PAIRS)) % count


def _frames(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return frames of pairs of directions, (N, 3) each: the bisector, the normal, and what is normal to both, as columns.

    The rotation between the frames of two pairs of directions is that of least squares (Kabsch 1976).
    """
    bisector, normal = first + second, np.cross(first, second)
    bisector, normal = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (bisector, normal))
    return np.stack([bisector, normal, np.cross(bisector, normal)], axis=-1)


# Matches that agree on a homography and determine its eight numbers: of as many, blurred against the noise of dark exposures,
# the corners are certain to about a pixel.
_DETERMINED = 100


class PointLocator(ABC):
    """Locates pairs from matched points: see `photonpano.Locator` and `photonpano.LocatesTurns`.

    A homography has eight numbers. Where matches do not determine them, and the camera only turns, the three of a rotation are
    tried. What `describe` returns has a `shape`, the (height, width) of the exposure.
    """

    _config: MatchingConfig
    _rounding_px = 0.0
    _camera_matrix: FloatArray | None = None

    def turning(self, camera_matrix: FloatArray) -> Self:
        """Return this locator for a camera that only turns.

        The camera matrix, (3, 3), is in px of the exposures; the lens does not distort.
        """
        turning = copy(self)
        turning._camera_matrix = camera_matrix
        return turning

    def register(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`.

        Returns:
            `NotLocated` with the numbers that decided when too few points match or agree, when they leave the corners of the
            frame uncertain, or when no camera moves like that.
        """
        motion = self._homography(moving, fixed, initial)
        if self._camera_matrix is None:
            return motion
        # The number that agreed at first: near their final motion some matches are chance.
        if isinstance(motion, Located) and motion.evidence.get("agreeing", motion.evidence["inliers"]) >= _DETERMINED:
            return motion
        matches = self._matches(moving, fixed, initial)
        evidence = {name: number for name, number in motion.evidence.items() if name.startswith("keypoints")}
        turn = turn_of(matches, moving.shape, self._config, self._camera_matrix, evidence, self._rounding_px)
        if isinstance(motion, Located) or isinstance(turn, Located):
            return turn if isinstance(turn, Located) else motion
        return NotLocated(f"{motion.reason}; as a rotation: {turn.reason}", motion.evidence)

    @abstractmethod
    def _homography(self, moving: Any, fixed: Any, initial: Homography | None) -> Located | NotLocated:
        """Match, and fit a homography."""

    @abstractmethod
    def _matches(self, moving: Any, fixed: Any, initial: Homography | None) -> Iterator[Matches]:
        """Yield the matches near the positions that `initial` predicts if there is one, then those in the whole image."""
