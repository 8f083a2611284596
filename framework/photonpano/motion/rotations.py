"""The motion of a camera that only turns, by any angle: its interpolation, and the trajectory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.protocols import Interpolator, Trajectory
from photonpano.geometry import Camera, inverse, nearest_rotations, rotation_matrices, rotation_vectors, scaled_ahead
from photonpano.motion.rotation_graph import Rotations
from photonpano.values import FloatArray

# Angle between the knots of the coarse path. Up to this angle, rotation vectors add up well enough for splines.
_STEP_RAD = np.deg2rad(30)
_HOLD = 2.0  # mean distances of the knots for which the coarse path goes on beyond its ends


class RotationTrajectory:
    """A trajectory of rotations of one camera; that of the reference frame is the identity.

    Convention:
        Homographies are K R K^-1 of determinant 1: they map ideal pixels of a frame to those of the reference frame, and h33
        is negative or zero where the camera looks backwards.
    """

    def __init__(self, free: Trajectory, camera: Camera, reference: float) -> None:
        """Take a trajectory of rotations of a camera, as homographies to any plane."""
        self.camera = camera  # of all frames
        self._free = free
        self._to_reference = self._free_rotations([reference])[0].T

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        return self.camera.homographies(self.rotations(frame_indices))

    def rotations(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the rotations from the camera at N instants to that of the reference frame: (N, 3, 3)."""
        return np.asarray(self._to_reference @ self._free_rotations(frame_indices))

    def _free_rotations(self, frame_indices: ArrayLike) -> FloatArray:
        return nearest_rotations(self.camera.rotations(self._free.at(frame_indices)))


class ReferencedTrajectory:
    """A trajectory whose homography at the reference frame is the identity.

    Convention:
        `at` maps a frame's pixels to the pixels of the reference frame; h33 = 1.
    """

    def __init__(self, free: Trajectory, reference: int) -> None:
        self._free = free
        self._to_reference = inverse(free.at([reference])[0])

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the homographies of N instants: (N, 3, 3)."""
        return scaled_ahead(self._to_reference @ self._free.at(frame_indices))


def fit_rotations(
    interpolator: Interpolator,
    instants: FloatArray,
    knots: Rotations,
    information: FloatArray | None,
    checked: Callable[..., Trajectory],
) -> Trajectory:
    """Interpolate N rotations by any angle at increasing instants, in frames.

    A coarse path passes some of the knots, 30 degrees apart; the interpolator gets the rotations of the others beyond it,
    which are small: as rotation vectors if it has `fit_turns`, else as homographies. `information` (N, 3, 3) is of their
    rotation vectors, each in its own frame. `checked` wraps what was fitted, given the (N, 3, 3) `homographies` of the knots.
    """
    path, camera = CoarsePath(instants, knots.rotations), knots.camera
    vectors = rotation_vectors(np.swapaxes(path.at(instants), -1, -2) @ knots.rotations)
    homographies = scaled_ahead(camera.homographies(rotation_matrices(vectors)))
    if hasattr(interpolator, "fit_turns"):
        fitted: Trajectory = _RotationVectors(interpolator.fit_turns(instants, vectors, information), camera)
    else:
        fitted = interpolator.fit(instants, homographies, None)
    return _Along(path, checked(fitted, homographies=homographies), camera)


class CoarsePath:
    """A smooth path of rotations through some of the knots; constant where all lie within 30 degrees of the middle one."""

    def __init__(self, instants: FloatArray, rotations: FloatArray) -> None:
        """Choose the (N, 3, 3) knots at (N,) instants that the path passes."""
        from scipy.spatial.transform import Rotation, RotationSpline

        middle = rotations[len(rotations) // 2]
        self._first, self._last = float(instants[0]), float(instants[-1])
        self._hold = _HOLD * (self._last - self._first) / max(1, len(instants) - 1)
        self._constant = middle
        self._spline = None
        if np.linalg.norm(rotation_vectors(middle.T @ rotations), axis=1).max() > _STEP_RAD:
            steps = np.linalg.norm(rotation_vectors(np.swapaxes(rotations[:-1], -1, -2) @ rotations[1:]), axis=1)
            travelled = np.concatenate([[0.0], np.cumsum(steps)])
            number = max(2, int(np.ceil(travelled[-1] / _STEP_RAD)) + 1)
            chosen = np.unique(np.searchsorted(travelled, np.linspace(0, travelled[-1], number)).clip(0, len(rotations) - 1))
            self._spline = RotationSpline(instants[chosen], Rotation.from_matrix(rotations[chosen]))
            gap = (self._last - self._first) * 1e-4
            ends = [(self._first, self._first + gap), (self._last - gap, self._last)]
            inside = [self._inside(np.array(end)) for end in ends]
            self._velocities = [rotation_vectors(before.T @ after) / gap for before, after in inside]

    def at(self, instants: ArrayLike) -> FloatArray:
        """Return the rotations of N instants, which go on at the same velocity beyond the ends for a while: (N, 3, 3)."""
        at = np.asarray(instants, dtype=np.float64)
        if self._spline is None:
            return np.broadcast_to(self._constant, (len(at), 3, 3))
        inside = np.clip(at, self._first, self._last)
        beyond = np.clip(at - inside, -self._hold, self._hold)
        found = self._inside(inside)
        for velocity, out in zip(self._velocities, (beyond < 0, beyond > 0), strict=True):
            found[out] = found[out] @ rotation_matrices(beyond[out, None] * velocity)
        return found

    def _inside(self, instants: FloatArray) -> FloatArray:
        assert self._spline is not None
        return np.array(self._spline(instants).as_matrix())


class _RotationVectors:
    """Rotation vectors as a trajectory of homographies."""

    def __init__(self, vectors: Callable[[FloatArray], FloatArray], camera: Camera) -> None:
        self._vectors, self._camera = vectors, camera

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        instants = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        return self._camera.homographies(rotation_matrices(self._vectors(instants)))


class _Along:
    """What an interpolator fitted, along the coarse path."""

    def __init__(self, path: CoarsePath, fitted: Trajectory, camera: Camera) -> None:
        self._path, self._fitted, self._camera = path, fitted, camera

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        instants = np.atleast_1d(np.asarray(frame_indices, dtype=np.float64))
        return np.asarray(self._camera.homographies(self._path.at(instants)) @ self._fitted.at(instants))
