"""Motions of pairs and spans.

A pair that is not located has a reason, never the identity for a failure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from photonpano.values.frames import FloatArray, FrameSpan, Homography

# Share by which information is raised so that it can be inverted, and a floor on it.
_SINGULAR, _TINY = 1e-9, 1e-200


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Where the patches of one image lie in another, beyond the homography between the images: a lens shows itself there."""

    # (P, 2) from where the homography maps the middle of a patch to where it lies, x and y in pixels of the fixed image. The
    # middles are those of `photonpano.geometry.patch_centres`
    shifts: FloatArray
    information: FloatArray  # (P, 2, 2) their inverse covariances, 0 for a patch that shows nothing

    def rescaled(self, scale: float) -> Patches:
        """Return them in pixels of images that are rescaled."""
        return Patches(self.shifts * scale, self.information / scale**2)


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """A pairwise motion that was found.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.
    """

    homography: Homography  # (3, 3) float64, h33 = 1
    # (8, 8) inverse covariance of the eight parameters p1..p8 of `homography` in the order of the paper (section 4,
    # "Interpolate"), None if the locator has none
    information: FloatArray | None = None
    # root mean square of the residuals after the fit, in pixels of the fixed image; None if unknown
    residual_px: float | None = None
    # counts of the locator by name (keypoints, matches, inliers, ...), for records and messages
    evidence: Mapping[str, float] = field(default_factory=dict)
    patches: Patches | None = None  # where patches of the moving image lie; None if the locator does not look at them


@dataclass(frozen=True, slots=True)
class NotLocated:
    """A pairwise motion that was not found."""

    reason: str  # a clause that completes "not located: ...", with the numbers that decided
    evidence: Mapping[str, float] = field(default_factory=dict)  # counts of the locator by name


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


@dataclass(frozen=True, slots=True, eq=False)
class SpanResiduals:
    """What the frames of short spans show of the motion, beyond a trajectory.

    Convention:
        A step moves points of a frame: what the frames of a span show at the point q, the trajectory predicts at `step(q)`. So
        `trajectory.at(frame) @ step` explains the photons better; `photonpano.geometry.step_motions` makes the (3, 3) matrices.
        Points are (x, y), integers are pixel centres.
    """

    spans: tuple[FrameSpan, ...]  # S spans of frames, in order; together they contain the located frames
    # (S, 4) float64, one weighted least-squares step of the motion of each span: shift along x and along y, in px of a frame;
    # roll from x towards y, in radians; zoom, as a fraction. Roll and zoom are about the centre of the frame
    steps: FloatArray
    # (S, 4, 4) float64, inverse covariance of the steps from photon noise alone; singular where the photons of a span do not
    # determine a step, which is then 0
    information: FloatArray

    @property
    def variances(self) -> FloatArray:
        """The variances of the steps, (S, 4), if all are unknown; infinite where the photons determine none."""
        scale = np.sqrt(np.maximum(np.diagonal(self.information, axis1=1, axis2=2), _TINY))
        unit = self.information / scale[:, :, None]
        unit /= scale[:, None, :]
        unit[:, range(4), range(4)] = 1 + _SINGULAR
        variances = np.diagonal(np.linalg.inv(unit), axis1=1, axis2=2)
        known = (scale**2 > _TINY) & (variances < 0.1 / _SINGULAR)
        return np.where(known, variances / scale**2, np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A motion that a refiner corrected.

    Convention:
        Homographies map pixels of a frame to pixels of the reference plane. That of the reference frame stays the identity.
    """

    homographies: FloatArray  # (T, 3, 3) float64, one for each frame of the capture, h33 = 1
    std_px: FloatArray  # (T,) expected corner error of each frame, in px of a frame; infinite where it was infinite before
    summary: str  # what was corrected, in one line, such as "tremor of 0.9 px at 223 and 590 Hz"
