"""From matched points to an accepted motion: consensus and least squares, the last steps of keypoint locators."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from photonpano.geometry import corners, from_parameters, jacobian, normalised, parameters, transform_points, why_implausible
from photonpano.locating.configs import PointLimits
from photonpano.robust import robust_std, soft_l1_weights
from photonpano.values import FloatArray, Homography, Located, NotLocated

Points = NDArray[np.floating]
# Rounds of reweighting; after 4 the weights of the soft L1 loss change the result by a few per cent of its error.
REWEIGHTINGS = 4
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


def motion_from_points(
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
    for _ in range(REWEIGHTINGS):
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
