"""The conformance kit of pose estimators: checks on a capture of a scene with depth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest

from photonpano import FloatArray, LocationError, Quiet
from photonpano.geometry import Camera, camera_matrix, rotation_matrices, transform_points
from photonpano.testing import MemorySource
from photonpano.testing.captures import ReadOnlySource
from photonpano.testing.conformance import Answer, AnswerConformance
from photonpano_poses.contract import CameraGuess, PoseEstimatorContribution, require_poses
from photonpano_poses.files import in_standard_world
from photonpano_poses.scores import pose_errors

POSES_SHAPE = (128, 160)
FOCAL_PX = 150.0
N_POSES = 320
_MATRIX = camera_matrix(FOCAL_PX, (79.5, 63.5))
# Depth, and left, top, right and bottom edge, in m: the farthest first.
PLANES = ((6.0, (-4, -4, 4, 4)), (3.5, (-1.6, -1.0, -0.5, 0.6)), (4.2, (0.4, -1.2, 1.6, 0.1)), (3.0, (-0.3, 0.2, 1.0, 1.1)))


def true_poses(travels: bool = True) -> FloatArray:
    """Return the poses (320, 3, 4) of a camera that moves to the right by 1.2 m, or that only turns by 20 degrees."""
    times = np.linspace(-1, 1, N_POSES)
    places = np.stack([0.6 * times, 0.1 * np.cos(3 * times), 0.15 * times**2], axis=1) * travels
    rotations = rotation_matrices(
        np.stack([0.02 * times, (0.06 if travels else 0.17) * times, 0.01 * np.sin(4 * times)], axis=1)
    )
    return np.concatenate([rotations, -(rotations @ places[..., None])], axis=-1)


@cache
def capture(travels: bool = True, distortion: tuple[float, float, float, float] = (0, 0, 0, 0)) -> MemorySource:
    """Simulate binary frames of a scene with depth, one photon a pixel, through a lens: k1, k2, p1, p2 as OpenCV has them."""
    pixels = np.stack(np.meshgrid(np.arange(POSES_SHAPE[1]), np.arange(POSES_SHAPE[0])), axis=-1)
    ideal = Camera(_MATRIX, np.array(distortion)).ideal(pixels)
    rng = np.random.default_rng(4)
    textures = []
    for depth, (left, top, right, bottom) in PLANES:
        size = round(FOCAL_PX * (bottom - top) / depth), round(FOCAL_PX * (right - left) / depth)
        textures.append(np.clip(1 + 5 * (cv2.GaussianBlur(rng.uniform(0, 1, size), (0, 0), 1.2) - 0.5), 0.1, 3))
    frames = np.empty((N_POSES, *POSES_SHAPE), np.uint8)
    for frame, pose in enumerate(true_poses(travels)):
        flux = np.zeros(POSES_SHAPE)
        for (depth, (left, top, right, bottom)), texture in zip(PLANES, textures, strict=True):
            height, width = texture.shape
            to_world = np.array([[(right - left) / width, 0, left], [0, (bottom - top) / height, top], [0, 0, depth]])
            to_frame = _MATRIX @ (pose[:, :3] @ to_world + np.outer(pose[:, 3], [0, 0, 1]))
            x, y = np.moveaxis(transform_points(np.linalg.inv(to_frame), ideal).astype(np.float32), -1, 0)
            seen = cv2.remap(texture, x, y, cv2.INTER_LINEAR, borderValue=-1)
            flux = np.where(seen > 0, seen, flux)
        frames[frame] = rng.random(POSES_SHAPE) < -np.expm1(-flux)
    return ReadOnlySource(frames)


class PoseEstimatorConformance(AnswerConformance):
    """Checks of a pose estimator.

    Attributes:
        config: the keys under `with`, for 320 frames of 128x160 px with one photon a pixel.
        tolerance: largest absolute trajectory error, as a share of the path.
        tolerance_deg: largest root mean square error of the rotations, in degrees.
        std_factor: allowed ratio between actual errors of positions and the expected ones, either way.
    """

    kind: ClassVar[str] = "pose-estimator"

    contribution: PoseEstimatorContribution
    tolerance: float = 0.03
    tolerance_deg: float = 2.0
    std_factor: float = 3.0
    _first: ClassVar[Any]

    def estimated(self, travels: bool = True) -> Any:
        """Estimate the poses of the capture."""
        source = capture(travels)
        estimator: Any = self.built(source.info)
        return estimator.estimate(source, CameraGuess(FOCAL_PX), Quiet())

    def answers(self) -> Iterator[Answer]:
        """Yield the estimate."""
        yield "what estimate() returned", self.first_estimate(), lambda found: require_poses(found, capture())

    def first_estimate(self) -> Any:
        """Estimate the poses once for several checks."""
        if "_first" not in type(self).__dict__:
            type(self)._first = self.estimated()
        return type(self)._first

    def test_estimate_finds_the_poses(self) -> None:
        """Positions and rotations are compared after the best similarity, and expected errors with actual ones."""
        estimate = self.first_estimate()
        scaled = in_standard_world(estimate)
        score = pose_errors(scaled.camera_from_world, true_poses(), scaled.located, 10, scaled.std_position)
        assert score.located_share > 0.9, f"only {100 * score.located_share:.0f} % of the frames are located"
        assert score.ate_share < self.tolerance, f"positions err by {100 * score.ate_share:.2g} % of the path"
        assert score.rotation_deg < self.tolerance_deg, f"rotations err by {score.rotation_deg:.2g} degrees"
        if score.std_ratio is not None:
            assert 1 / self.std_factor < score.std_ratio < self.std_factor, (
                f"errors of positions are {score.std_ratio:.2g} times std_position; correct it, or set inf if it is not known"
            )
        np.testing.assert_array_equal(estimate.camera_matrix[0, 0], FOCAL_PX, "a focal length that is given must be kept")
        for view in estimate.views[:1]:
            assert view.flux().shape == POSES_SHAPE, "the flux of a view must have the shape of a frame"

    def test_estimate_is_deterministic(self) -> None:
        """The same seed gives the same poses, so that a run can be repeated."""
        first, second = (each.camera_from_world for each in (self.first_estimate(), self.estimated()))
        np.testing.assert_array_equal(first, second, "estimate() found other poses for the same capture and seed")

    def test_camera_that_only_turns_has_no_poses(self) -> None:
        """It sees no depth: any positions would be noise."""
        with pytest.raises(LocationError):
            self.estimated(travels=False)
