"""From matched points to the rotation of a camera that only turns: three numbers, where matches do not determine eight."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from photonpano.geometry import (
    Camera,
    jacobian,
    nearest_rotations,
    normalised,
    rotation_matrices,
    transform_points,
    why_implausible,
)
from photonpano.locating.configs import MatchingConfig
from photonpano.locating.points import MIN_NOISE_PX, Matches
from photonpano.locating.turns import information_on_turn, turn_slopes
from photonpano.robust import robust_std, soft_l1_weights
from photonpano.values import BoolArray, FloatArray, Homography, Located, NotLocated

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


def turn_of(
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
        motion = _turn(matches, shape, limits, Camera(camera_matrix), dict(evidence or {}), rounding_px)
        if isinstance(motion, Located):
            break
    return motion


def _turn(
    matches: Matches,
    shape: tuple[int, int],
    limits: MatchingConfig,
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
        agrees, residuals, scale = _residuals(moving, fixed, homography, threshold_px)
        root = np.sqrt(soft_l1_weights(np.linalg.norm(residuals, axis=1), scale))[:, None]
        slopes = jacobian(homography, moving[agrees]) @ turn_slopes(homography, camera.matrix)
        step = np.linalg.lstsq((slopes * root[..., None]).reshape(-1, 3), -(residuals * root).ravel(), rcond=None)[0]
        homography = normalised(homography @ camera.homographies(rotation_matrices(step)))
    agrees, residuals, scale = _residuals(moving, fixed, homography, threshold_px)
    slopes = jacobian(homography, moving[agrees]).reshape(-1, 8)
    residual_px = float(np.sqrt((residuals**2).sum() / max(1, residuals.size - 3)))
    each = _information(np.linalg.norm(transform_points(homography, moving) - fixed, axis=1), scale, threshold_px)
    return _Fit(homography, agrees, residual_px, slopes.T @ slopes * each)


def _residuals(
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
