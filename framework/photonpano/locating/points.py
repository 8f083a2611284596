"""From matched points to a motion: the end of every locator that works with keypoints."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import apply, why_implausible
from photonpano.locating.configs import PointLimits
from photonpano.locating.fitting import fit_homography
from photonpano.values import Homography, Located, NotLocated


def least_agreeing(matches: int, guided: bool) -> float:
    """Return how many matches must agree to tell a motion from chance, in the form of Brown and Lowe (2007, section 3.2).

    Near where a motion is predicted, keypoints of pure noise match as well: 10 to 16 % of them agree on something, while 60 %
    and more do of a scene at 0.01 photons per pixel per frame. All over the image chance agrees on next to nothing, but of
    matches between exposures that are blurred, few agree to a pixel or two even when the motion is right.
    """
    return 8.0 + (0.3 if guided else 0.1) * matches


def motion_from_points(
    moving: NDArray[np.floating],
    fixed: NDArray[np.floating],
    start: Homography,
    shape: tuple[int, int],
    limits: PointLimits,
    *,
    sizes: NDArray[np.floating] | None = None,
    evidence: Mapping[str, float] | None = None,
    rounds: int = 2,
    rounding_px: float = 0.0,
) -> Located | NotLocated:
    """Fit a motion to the matches that agree with it, by least squares, and judge it. Raises nothing.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Args:
        moving: (N, 2) points of the moving image.
        fixed: (N, 2) their partners.
        start: (3, 3) the motion that a consensus of the matches, such as RANSAC, found.
        shape: (height, width) of both images.
        limits: what it takes to be believed.
        sizes: (N,) diameters of the keypoints, where they differ; where a keypoint lies is known in proportion.
        evidence: what the backend counted, for the record.
        rounds: how often inliers are chosen and fitted.
        rounding_px: standard deviation of what all matches may err alike, as they do where points are known to whole pixels.

    Returns:
        `Located` with the information that the residuals give, `evidence`, and the numbers of `matches` and `inliers`; or
        `NotLocated` where there are too few inliers, where they leave the corners of the frame uncertain, or where no camera
        moves like that.
    """
    found = dict(evidence or {})
    found.setdefault("matches", float(len(moving)))
    if reason := why_implausible(start, shape):
        return NotLocated(f"{reason}, from {len(moving)} matches", found)
    sizes = np.ones(len(moving)) if sizes is None else sizes
    homography = start
    for _ in range(rounds):
        inliers = np.linalg.norm(apply(homography, moving) - fixed, axis=1) <= limits.threshold_px
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
