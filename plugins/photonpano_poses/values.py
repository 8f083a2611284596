"""What a pose estimator is told, and what it finds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, FluxImage, FrameSpan, Reason


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
        the world are free: a run moves them, so that the first located camera is the origin and looks along z, and so
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
