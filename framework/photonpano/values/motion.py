"""Motions of pairs and spans, and poses of a camera that travels through a scene.

A pair that is not located has a reason, never the identity for a failure.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photonpano.values.frames import BoolArray, FloatArray, FluxImage, FrameSpan, Homography
from photonpano.values.verdict import Reason

# Share by which information is raised so that it can be inverted, and a floor on it.
_SINGULAR, _TINY = 1e-9, 1e-200


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Where the patches of one image lie in another, beyond the homography between the images: a lens shows itself there.

    Attributes:
        shifts: (P, 2) from where the homography maps the middle of a patch to where it lies, x and y in pixels of the fixed
            image. The middles are those of `photonpano.geometry.patch_centres`.
        information: (P, 2, 2) their inverse covariances, 0 for a patch that shows nothing.
    """

    shifts: FloatArray
    information: FloatArray

    def rescaled(self, scale: float) -> Patches:
        """Return them in pixels of images that are rescaled."""
        return Patches(self.shifts * scale, self.information / scale**2)


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
        patches: where patches of the moving image lie; None if the locator does not look at them.
    """

    homography: Homography
    information: FloatArray | None = None
    residual_px: float | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)
    patches: Patches | None = None


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


@dataclass(frozen=True, slots=True, eq=False)
class SpanResiduals:
    """What the frames of short spans show of the motion, beyond a trajectory.

    Convention:
        A step moves points of a frame: what the frames of a span show at the point q, the trajectory predicts at `step(q)`. So
        `trajectory.at(frame) @ step` explains the photons better; `photonpano.geometry.step_motions` makes the (3, 3) matrices.
        Points are (x, y), integers are pixel centres.

    Attributes:
        spans: S spans of frames, in order; together they contain the located frames.
        steps: (S, 4) float64, one weighted least-squares step of the motion of each span: shift along x and along y, in px of a
            frame; roll from x towards y, in radians; zoom, as a fraction. Roll and zoom are about the centre of the frame.
        information: (S, 4, 4) float64, inverse covariance of the steps from photon noise alone; singular where the photons of
            a span do not determine a step, which is then 0.
    """

    spans: tuple[FrameSpan, ...]
    steps: FloatArray
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

    Attributes:
        homographies: (T, 3, 3) float64, one for each frame of the capture, h33 = 1.
        std_px: (T,) expected corner error of each frame, in px of a frame; infinite where it was infinite before.
        summary: what was corrected, in one line, such as "tremor of 0.9 px at 223 and 590 Hz".
    """

    homographies: FloatArray
    std_px: FloatArray
    summary: str


@dataclass(frozen=True, slots=True)
class CameraGuess:
    """What is known of a camera before its poses are estimated.

    Attributes:
        focal_px: focal length in px of a frame; None if it is to be found.
        centre_px: (x, y) of the principal point, in px of a frame, integers are pixel centres; None for the middle of a frame.
        distortion: k1, k2, p1, p2 of the lens as OpenCV defines them, which are known.
    """

    focal_px: float | None = None
    centre_px: tuple[float, float] | None = None
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class ScenePoints:
    """Points of the scene.

    Attributes:
        positions: (N, 3) float64, in the world.
        flux: (N,) float32, photons per pixel per frame where exposures show them; NaN where it is not known.
    """

    positions: FloatArray
    flux: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class PosedView:
    """A virtual exposure whose pose was found from the points that it shows.

    Attributes:
        span: the frames that were merged.
        instant: the instant from which it is seen, in frames.
        camera_from_world: (3, 4), its pose.
        points: (K,) indices of the points that were found in it.
        xy: (K, 2) where these were found, in px of a frame with its distortion; integers are pixel centres.
        flux: returns the exposure, (H, W) float32, photons per pixel per frame, NaN where unknown. It may read the capture.
    """

    span: FrameSpan
    instant: float
    camera_from_world: FloatArray
    points: NDArray[np.intp]
    xy: FloatArray
    flux: Callable[[], FluxImage]


@dataclass(frozen=True, slots=True)
class LostFrames:
    """Frames whose pose was not found.

    Attributes:
        span: the frames.
        reason: a clause that completes "not located: ...", with the numbers that decided.
    """

    span: FrameSpan
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class PoseEstimate:
    """The pose of every frame, and the points that the camera has seen.

    Convention:
        Points of the world are (x, y, z): x right, y down, z ahead. A pose (3, 4) maps them to points of the camera,
        X_c = R X_w + t, with the same axes; ideal pixels are K X_c, integers are pixel centres. The scale and the origin of
        the world are free: the framework moves them, so that the first located camera is the origin and looks along z, and so
        that the path of the located cameras has the length 1.

    Attributes:
        camera_matrix: (3, 3) K, in px of a frame.
        distortion: (4,) k1, k2, p1, p2 as OpenCV defines them.
        std_focal_px: expected error of the focal length; 0 if it was given, inf if it is not known.
        camera_from_world: (T, 3, 4) float64; NaN where a frame is not located, never an identity.
        located: (T,) whether the pose of a frame was found.
        std_position: (T,) expected distance of the camera from its true place, root mean square, in units of the world; NaN
            where not located, inf where it is not known.
        std_rotation_deg: (T,) expected angle between the found and the true rotation, root mean square, in degrees; NaN where
            not located, inf where it is not known.
        points: of the scene.
        views: the exposures whose poses were found, in order of their instants.
        lost: the frames that are not located, with reasons.
        levels: a record for each level: numbers and texts by name.
        doubts: why the poses may be wrong, as far as the estimator can tell; empty if it trusts them.
        residual_ratio: median distance of the points from where the views show them, in units of what photon noise explains;
            None if that is not known.
    """

    camera_matrix: FloatArray
    distortion: FloatArray
    std_focal_px: float
    camera_from_world: FloatArray
    located: BoolArray
    std_position: FloatArray
    std_rotation_deg: FloatArray
    points: ScenePoints
    views: tuple[PosedView, ...] = ()
    lost: tuple[LostFrames, ...] = ()
    levels: tuple[Mapping[str, float | int | str | None], ...] = ()
    doubts: tuple[Reason, ...] = ()
    residual_ratio: float | None = None
