"""A refined motion, which is known at every frame, and what a level corrects of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import (
    Camera,
    FrameTrajectory,
    from_parameters,
    inverse,
    likely_rotations,
    nearest_rotations,
    parameters,
    scaled_ahead,
)
from photonpano.motion.locate import LocatedLevel
from photonpano.motion.rotation_graph import Rotations
from photonpano.motion.rotations import RotationTrajectory
from photonpano.values import FloatArray


class Knots(NamedTuple):
    """What an interpolator passes at the instants of N located exposures."""

    instants: FloatArray  # (N,)
    homographies: FloatArray  # (N, 3, 3)
    information: FloatArray | None  # see `LocatedLevel`
    rotations: Rotations | None  # of a camera that turns; None for homographies

    @classmethod
    def of(cls, located: LocatedLevel) -> Knots:
        """Return the motions of the exposures themselves."""
        return cls(located.instants, located.homographies, located.information, located.solution.rotations)

    def moved(self, homographies: FloatArray) -> Knots:
        """Return the knots after a small motion of each frame: (N, 3, 3)."""
        found, rotations = scaled_ahead(self.homographies @ homographies), self.rotations
        if rotations is not None:
            turned = rotations.rotations @ nearest_rotations(rotations.camera.rotations(homographies))
            found, rotations = rotations.camera.homographies(turned), Rotations(turned, rotations.camera)
        return self._replace(homographies=found, rotations=rotations)


class RefinedMotion:
    """A refined motion, which exposures merged along it correct.

    The corrections change slowly, even where the motion trembles faster than the exposures follow each other.
    """

    def __init__(self, motion: Trajectory, n_frames: int, camera: Camera | None, frame_shape: tuple[int, int]) -> None:
        """Take the motion of the frames as that of a camera, if it turns: one of another focal length moves the image alike."""
        known = motion.at(np.arange(n_frames))
        if camera is not None:
            if isinstance(motion, RotationTrajectory):
                turned = Rotations(motion.camera.rotations(known), motion.camera).seen_by(camera).rotations
            else:
                turned = likely_rotations(camera, known, frame_shape)
            known = camera.homographies(turned)
        self._known = FrameTrajectory(known)

    def corrections(self, knots: Knots) -> Knots:
        """Return the small motions of the frames after which the known motion is that of the exposures."""
        instants, homographies, information, rotations = knots
        known, middle = self._known.at(instants), len(homographies) // 2
        back = inverse(known) @ known[middle] @ inverse(homographies[middle])
        found = scaled_ahead(back @ homographies)
        if rotations is not None:
            turned = nearest_rotations(rotations.camera.rotations(found))
            return Knots(instants, found, information, Rotations(turned, rotations.camera))
        if information is not None:
            # The derivatives of p1..p8 of what was found by those of the homographies.
            changes = (back[:, None] @ (from_parameters(np.eye(8)) - np.eye(3))) / (back @ homographies)[:, None, 2:, 2:]
            slopes = parameters(np.eye(3) + changes - found[:, None] * changes[..., 2:, 2:])
            to_corrections = np.linalg.inv(np.swapaxes(slopes, -1, -2))
            information = np.swapaxes(to_corrections, -1, -2) @ information @ to_corrections
        return Knots(instants, found, information, None)

    def corrected(self, corrections: Trajectory) -> Trajectory:
        """Return the known motion, each frame of which is corrected."""
        return _Corrected(self._known, corrections)


class _Corrected(NamedTuple):
    known: Trajectory
    corrections: Trajectory

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        return np.asarray(self.known.at(frame_indices) @ self.corrections.at(frame_indices))
