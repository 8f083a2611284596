"""From matched points to an accepted motion: consensus and least squares, the last steps of keypoint locators."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import normalised, transform_points, why_implausible
from photonpano.locating.configs import PointLimits
from photonpano.locating.fitting import fit_homography
from photonpano.values import Homography, Located, NotLocated

Points = NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Matched points of two images.

    Attributes:
        moving: (N, 2) points of the moving image; integers are pixel centres.
        fixed: (N, 2) their partners.
        guided: whether partners were searched near the position that a motion predicts, and not in the whole image.
        sizes: (N,) diameters of the keypoints, None if all are equal.
    """

    moving: Points
    fixed: Points
    guided: bool
    sizes: Points | None = None


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
        by_chance = _agreeing_by_chance(count, matches.guided)
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


def _agreeing_by_chance(matches: int, guided: bool) -> float:
    """Return the largest number of matches that may agree by chance, in the form of Brown and Lowe (2007, section 3.2).

    Near a predicted position keypoints of pure noise match as well: 10 to 16 % of them agree, and 60 % and more do for a scene
    at 0.01 photons per pixel per frame. In the whole image next to none agree by chance, but of matches between blurred
    exposures few agree to a pixel or two even if the motion is right.
    """
    return 8.0 + (0.3 if guided else 0.1) * matches


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
