"""What a level adds to a trajectory: its expected error, frame by frame, and the corrections of a refined motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.protocols import Trajectory, camera_of_motion
from photonpano.geometry import (
    Camera,
    FrameTrajectory,
    align_planes,
    align_rotations,
    corner_displacements,
    from_parameters,
    inverse,
    likely_rotations,
    nearest_rotations,
    parameters,
    scaled_ahead,
)
from photonpano.motion.level import Timeline
from photonpano.motion.locate import LocatedLevel
from photonpano.motion.rotations import Rotations, RotationTrajectory
from photonpano.values import FloatArray

_COMPARED = 1000  # number of frames at which two levels are compared
# Error after a level, as a share of the change it made: each level removes at least three quarters of the error.
REMAINING_SHARE = 0.25
_BLUR_SHARE = 0.02  # error after the first level, as a share of the motion within a group, by which its exposures are blurred


@dataclass(frozen=True, slots=True, eq=False)
class Interpolated:
    """The motion through the located exposures of a level."""

    trajectory: Trajectory
    std_px: FloatArray  # (N,) its expected errors at their instants due to photon noise: a part of those of the exposures
    beyond_px: FloatArray  # (N,) how far exposures lie beside it, beyond what noise explains


class Uncertainty:
    """The expected corner error of a trajectory at any frame, in px, after the best alignment of the planes.

    It combines the expected error at the located instants, due to photon noise; the extrapolation at constant velocity beyond
    the first and the last of them; and what another level may find: how far exposures lie beside the motion, and a share of
    the last change, since exposures merged along a wrong motion confirm it.
    """

    change_px: float | None  # mean displacement of the corners since the previous level, px of a frame; None at the first level
    # (5,) expected errors of the focal length, in px, and of k1, k2, p1 and p2, 0 for what is given; None for
    # homographies, and for a single exposure
    std_camera: FloatArray | None

    def __init__(
        self,
        located: LocatedLevel,
        interpolated: Interpolated,
        previous: Trajectory | None,
        timeline: Timeline,
    ) -> None:
        """Compare a level with the one before, None at the first; beyond a cut, nothing is known from the other side."""
        trajectory = interpolated.trajectory
        turned, before = located.solution.rotations, camera_of_motion(previous)
        # A single exposure tells nothing of its camera.
        std_camera = located.assessed.std_camera
        self.std_camera = std_camera if len(std_camera) else None
        if self.std_camera is not None and turned is not None and before is not None:
            change = turned.camera.numbers - before.numbers
            self.std_camera = np.hypot(self.std_camera, REMAINING_SHARE * change)
        self._instants = located.instants
        self._std_px, self._beyond_px = interpolated.std_px, interpolated.beyond_px
        self._timeline = timeline
        shown = np.flatnonzero(timeline.shown)
        self._frames = shown[np.unique(np.linspace(0, len(shown) - 1, _COMPARED).round().astype(int))].astype(np.float64)
        shape, current = located.frame_shape, trajectory.at(self._frames)
        if previous is None:
            half = np.median([len(group.span) for group in located.groups]) / 2
            within_group = inverse(trajectory.at(self._frames - half)) @ trajectory.at(self._frames + half)
            self.change_px = None
            self._remaining_px = _BLUR_SHARE * corner_displacements(within_group, np.eye(3), shape).mean(axis=-1)
        else:
            known, start = previous.at(self._frames), None
            if isinstance(trajectory, RotationTrajectory) and isinstance(previous, RotationTrajectory):
                rotations = trajectory.rotations(self._frames), previous.rotations(self._frames)
                start = previous.camera.homographies(align_rotations(*rotations))
            moved = inverse(known) @ align_planes(current, known, shape, start) @ current
            changes_px = corner_displacements(moved, np.eye(3), shape).mean(axis=-1)
            self.change_px = float(changes_px.mean())
            self._remaining_px = REMAINING_SHARE * changes_px

    @property
    def mean_px(self) -> float:
        """Mean over the frames of the expected corner error due to photon noise and extrapolation alone."""
        return float(self._noise_px(self._frames).mean())

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the expected corner error at N instants, in px: (N,). Infinite if a single exposure was located."""
        frames = np.asarray(frame_indices, dtype=np.float64)
        return np.asarray(np.hypot(self._noise_px(frames), self.remaining_at(frames)))

    def remaining_at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the part of that error that another level may find: (N,)."""
        frames = np.asarray(frame_indices, dtype=np.float64)
        of_change = np.interp(frames, self._frames, self._remaining_px)
        return np.asarray(np.hypot(of_change, np.interp(frames, self._instants, self._beyond_px)))

    def _noise_px(self, frames: FloatArray) -> FloatArray:
        noise_px = np.full(frames.shape, np.inf)
        knots, pieces = self._timeline.knot_pieces(self._instants), self._timeline.piece_of(frames)
        for number, piece in enumerate(knots):
            instants, here = self._instants[piece], pieces == number
            if len(instants) < 2 or not here.any():
                continue
            inside = np.interp(frames[here], instants, self._std_px[piece])
            first, last = np.diff(instants)[[0, -1]]
            beyond = np.maximum((instants[0] - frames[here]) / first, (frames[here] - instants[-1]) / last)
            noise_px[here] = inside * (1 + 2 * np.maximum(beyond, 0))
        return np.asarray(np.hypot(noise_px, self._timeline.unknown_px(frames)))


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
