"""Pairwise motions: located with their quality, or not located with the reason. Never an identity for a failure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from photonpano.values.arrays import FloatArray, Homography


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A pairwise motion that was found.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Attributes:
        homography: (3, 3) float64, h33 = 1.
        information: (8, 8) inverse covariance of the eight parameters p1..p8 of `homography` in the order of the paper
            (section 4, "Interpolate"), None if the locator has none.
        residual_px: root mean square of the residuals after the fit, in pixels of the fixed image; None if unknown.
        evidence: counts of the locator by name (keypoints, matches, inliers, ...), for records and messages.
    """

    homography: Homography
    information: FloatArray | None = None
    residual_px: float | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class NotLocated:
    """A pairwise motion that was not found.

    Attributes:
        reason: a clause that completes "not located: ...", with the numbers that decided.
        evidence: counts of the locator by name.
    """

    reason: str
    evidence: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A pair of virtual exposures in the motion graph, with its motion."""

    moving: int  # index of the exposure that is mapped
    fixed: int  # index of the exposure that it is mapped to
    motion: Located | NotLocated  # the map in pixels of frames (not of rescaled exposures), or the reason why there is none
    locator: str = ""  # the name of the locator that found the motion; empty where none did


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """Pairs of a level that fit a scene that repeats at more than one place, and that nothing decided between."""

    level: int
    pairs: tuple[tuple[int, int], ...]  # (moving, fixed) numbers of the exposures of each pair, in order
    alternative_px: float  # how far from the motion taken the other one is, in px of a frame: the median of the pairs
