"""A gyroscope as a prior of the motion: the rotations by its rates, and the pairs of exposures that these tie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from photonpano.errors import InputError
from photonpano.geometry import (
    ROTATION_AXES,
    Camera,
    FrameTrajectory,
    corner_displacements,
    corners,
    inverse,
    jacobian,
    normalised,
    rotation_vectors,
    slopes,
)
from photonpano.motion.pairs import GYROSCOPE, instants_of
from photonpano.motion.rates import Rates
from photonpano.motion.rotations import RotationTrajectory
from photonpano.values import Decision, Edge, FloatArray, Group, Homography, Located

if TYPE_CHECKING:
    from photonpano.motion.graph import GraphSolution

_SCALE = 0.01  # expected error of the rates, and of the focal length, relative to them
_STIFF = 0.1  # expected departure of the corners from a rotation, relative to the error of the rotation
_CONTRADICTION = 5.0  # median of the differences between gyroscope and motion, in expected ones


@dataclass(frozen=True, slots=True, eq=False)
class Gyroscope:
    """Rates about the axes of the camera, and what was found of them."""

    rates: Rates
    camera: Camera
    frame_shape: tuple[int, int]  # (height, width) of a frame
    frames_s: FloatArray  # (T,) times of the frames by the clock of the gyroscope
    noise: float  # density of white noise, in rad/s per square root of Hz
    bias_rad_s: FloatArray  # (3,)
    std_bias_rad_s: FloatArray  # (3,)
    std_offset_s: float  # of the times of the frames

    def trajectory(self, reference: int) -> RotationTrajectory:
        """Return the motion of the frames by the rates alone."""
        rotations = self.rates.rotations(self.frames_s, self.bias_rad_s)
        return RotationTrajectory(FrameTrajectory(self.camera.homographies(rotations)), self.camera, reference)

    def edges(self, groups: Sequence[Group]) -> tuple[Edge, ...]:
        """Return the motion of each exposure to the one before, with the expected error of its rotation.

        Noise adds up as a random walk. Errors that stay the same, those of bias and scale, count as random walks that lead as
        far over the whole capture as they do.
        """
        times_s = np.interp(instants_of(groups), np.arange(len(self.frames_s)), self.frames_s)
        rotations = self.rates.rotations(times_s, self.bias_rad_s)
        between = np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]
        vectors, seconds = rotation_vectors(between), np.diff(times_s)[:, None]
        angles, velocities = np.abs(vectors), vectors / np.maximum(seconds, 1e-12)
        variances = seconds * (self.noise**2 + self.std_bias_rad_s**2 * seconds.sum()) + _SCALE**2 * angles * angles.sum(axis=0)
        variances += (self.std_offset_s * np.diff(velocities, axis=0, prepend=velocities[:1])) ** 2
        motions = map(self._located, self.camera.homographies(between), variances)
        return tuple(Edge(index + 1, index, motion, GYROSCOPE) for index, motion in enumerate(motions))

    def _located(self, motion: Homography, variance: FloatArray) -> Located:
        """Return a motion with the (3,) variances of its rotation vector."""
        turned = self._of_corners(motion)
        std_px = float(np.sqrt((turned**2 @ variance).sum() / 4))
        covariance = turned * variance @ turned.T + (_STIFF * std_px) ** 2 * np.eye(8)
        by_parameters = jacobian(normalised(motion), corners(self.frame_shape)).reshape(8, 8)
        information = by_parameters.T @ np.linalg.inv(covariance) @ by_parameters
        return Located(normalised(motion), information, evidence={"std_px": std_px})

    def _of_corners(self, motion: Homography) -> FloatArray:
        """Return the derivatives of where a motion puts the corners by its rotation vector: (8, 3)."""
        rows = np.concatenate([corners(self.frame_shape), np.ones((4, 1))], axis=1).T
        return slopes(motion @ rows, motion @ self.camera.homographies(ROTATION_AXES) @ rows)

    def agreement(self, edges: Sequence[Edge], solution: GraphSolution, std_px: float) -> Decision:
        """Compare the gyroscope with the motion of exposures, of the given expected error, that was solved.

        Raises:
            InputError: they differ by much more than expected.
        """
        away, expected, weights = [0.0], [0.0], {True: 0.0, False: 0.0}
        for edge in edges:
            if not isinstance(edge.motion, Located) or edge.motion.information is None:
                continue
            motion, is_ours = edge.motion.homography, edge.locator == GYROSCOPE
            of_parameters = np.linalg.solve(jacobian(motion, corners(self.frame_shape)).reshape(8, 8), self._of_corners(motion))
            weights[is_ours] += float(np.trace(of_parameters.T @ edge.motion.information @ of_parameters))
            if is_ours:
                solved = inverse(solution.homographies[edge.fixed]) @ solution.homographies[edge.moving]
                away.append(float(corner_displacements(solved, motion, self.frame_shape).mean()))
                expected.append(float(np.hypot(edge.motion.evidence["std_px"], std_px)))
        differs = f"{np.median(away):.2g} px from one exposure to the next, where {np.median(expected):.2g} px are expected"
        if np.median(away) > _CONTRADICTION * np.median(expected):
            raise InputError(
                f"{self.rates.file}: the rates contradict the images by {differs}; is it of this capture, and are "
                "motion.prior.axes, motion.prior.time_offset_s and camera.focal_px right?"
            )
        share = weights[True] / max(sum(weights.values()), 1e-12)
        reason = f"of what pairs of exposures show of rotations, {share:.0%} is by the gyroscope"
        return Decision("gyroscope_agreement", f"differs by {differs}", reason)
