"""The motion of a rotating camera: its graph, with a camera that all exposures share, its interpolation and its trajectory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from photonpano.contracts.protocols import Interpolator, Trajectory
from photonpano.geometry import (
    ROTATION_AXES,
    Camera,
    camera_matrix,
    corners,
    generators,
    inverse,
    nearest_rotations,
    patch_centres,
    rotation_matrices,
    rotation_vectors,
    rotations_between,
    scaled_ahead,
    slopes,
    transform_points,
)
from photonpano.motion.adjustment import CAUCHY, Adjustment, Prior, Problem, remembered
from photonpano.robust import robust_std
from photonpano.values import FloatArray, Located

_FEWEST = 7  # patches that determine a homography
_DAMPING, _TINY = 1e-9, 1e-30
# Prior of the focal length, in sides of a frame, and the standard deviation of its logarithm.
_PRIOR_FOCAL, _PRIOR_STD = 3.0, 2.0
# That of the shift of a corner by k1, in half diagonals, with which it is fitted: of a long focal length, small ones are large
# numbers. Models are compared by a prior of Cauchy, to which these are hardly less likely.
_PRIOR_BEND = 0.1
_STEP = 1e-5  # step of numerical derivatives
_MOST_TRIED = 400  # edges by which the first focal length is chosen
# A rotation of a camera that turns by more, in radians, is another one seen from the other side: its vector cannot be scaled.
_UNIQUE_TURN = 2.0
_MOST_ZOOM = 10.0  # of one step
_HOLD = 2.0  # mean distances of the knots for which the coarse path goes on beyond its ends
_FOCAL_LENGTHS = np.geomspace(0.2, 100, 49)  # tried first, in sides of a frame
_PRIOR_DISTORTION = np.array([0.3, 0.3, 0.03, 0.03])  # prior standard deviations of k1, k2, p1 and p2, as lenses have them
_POWERS = np.array([2, 4, 1, 1])  # of the focal length, with which k1, k2, p1 and p2 grow if the lens bends pixels alike
# Angle between the knots of the coarse path. Up to this angle, rotation vectors add up well enough for splines.
_STEP_RAD = np.deg2rad(30)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LensShift:
    """What undistorting pixels with the wrong lens does to pairs: it changes their homographies, and bends their patches."""

    points: FloatArray  # (P, 2) middles of the patches
    shifts: FloatArray  # (E, P, 2) where the patches of each pair lie beyond its homography, px; 0 where they are not known
    roots: FloatArray  # (E, P, 2, 2) R of their information R' R
    of_homography: FloatArray  # (E, 2 P, 8) derivatives of the patches by a small homography of each pair
    fitted: FloatArray  # (E, 8, 2 P) from shifts of the patches to the homography that explains them best
    to_corners: FloatArray  # (E, 8, 8) from that to the shifts of the corners

    @classmethod
    def of(cls, frame_shape: tuple[int, int], motions: Sequence[Located], counts: FloatArray) -> LensShift:
        """Take the patches of pairs, with the weights `counts`, (E,); without patches, those that both exposures see."""
        (height, width), points = frame_shape, patch_centres(frame_shape)
        observed = np.array([motion.homography for motion in motions])

        def slopes_at(places: FloatArray) -> FloatArray:
            there = observed @ np.concatenate([places, np.ones((len(places), 1))], axis=1).T
            return slopes(there, generators(frame_shape) @ there[:, None])

        mapped = transform_points(observed, points)
        seen = np.all((mapped >= 0) & (mapped <= [width - 1, height - 1]), axis=-1)
        # Four points at least determine a homography; a pair that hardly overlaps takes all.
        seen[seen.sum(axis=1) < _FEWEST] = True
        shifts, weights = np.zeros((*seen.shape, 2)), seen[..., None, None] * np.eye(2)
        shown = np.zeros(len(seen), dtype=bool)
        for edge, patches in enumerate(motion.patches for motion in motions):
            if patches is not None and (patches.information[:, 0, 0] > 0).sum() >= _FEWEST:
                shown[edge], shifts[edge], weights[edge] = True, patches.shifts, patches.information
        values, vectors = np.linalg.eigh((counts * shown)[:, None, None, None] * weights)
        roots = np.sqrt(np.maximum(values, 0))[..., None] * np.swapaxes(vectors, -1, -2)
        by_points = slopes_at(points)
        weighted = weights @ by_points.reshape(*seen.shape, 2, 8)
        weighted = np.swapaxes(weighted.reshape(by_points.shape), -1, -2)
        normal = weighted @ by_points
        normal += _DAMPING * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(8)
        found = cls(
            points=points,
            shifts=shifts,
            roots=roots,
            of_homography=by_points,
            fitted=np.linalg.solve(normal, weighted),
            to_corners=slopes_at(corners(frame_shape)),
        )
        noise = robust_std(found.unexplained()[roots.any(axis=(2, 3)).repeat(2)])
        return replace(found, roots=roots / max(noise, 1.0))

    def of_patches(self, relative: FloatArray, camera: Camera, assumed: Camera) -> FloatArray:
        """Return how patches are shifted by undistorting with the wrong lens: (E, 2 P) px, NaN if that folds the frame.

        `relative` (E, 3, 3) map ideal pixels of the true camera; pixels were undistorted with the one that was `assumed`.
        """
        there = transform_points(relative, self.points)
        seen = camera.distorted(transform_points(relative, camera.ideal(assumed.distorted(self.points))))
        return assumed.ideal_shift(there, seen - assumed.distorted(there)).reshape(len(relative), -1)

    def of_corners(self, shift: FloatArray) -> FloatArray:
        """Return by how much shifts of the patches, (E, 2 P), displace the corners of the homography: (E, 4, 2) px."""
        return np.asarray(self.to_corners @ (self.fitted @ shift[..., None])).reshape(-1, 4, 2)

    def unexplained(self, shift: FloatArray | None = None) -> FloatArray:
        """Return what shifts leave of those that were seen, beyond homographies: (2 E P,) of unit variance, outliers less."""
        left = self.shifts
        if shift is not None:
            bent = shift - (self.of_homography @ (self.fitted @ shift[..., None]))[..., 0]
            left = left - bent.reshape(left.shape)
        whitened = np.einsum("epij,epj->epi", self.roots, left)
        squares = (whitened**2).sum(axis=-1, keepdims=True) / CAUCHY**2
        return np.asarray(whitened * np.sqrt(np.log1p(squares) / np.maximum(squares, _TINY))).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class Rotations:
    """The rotations of a camera."""

    rotations: FloatArray  # (N, 3, 3) from the camera at each node to that at the anchor
    camera: Camera  # of all of them

    def of(self, nodes: slice) -> Rotations:
        """Return the rotations of some nodes."""
        return Rotations(self.rotations[nodes], self.camera)

    def seen_by(self, camera: Camera) -> Rotations:
        """Return the rotations of a camera of another focal length that move the image alike, unless some turn far."""
        vectors = rotation_vectors(self.rotations)
        if camera.focal_px == self.camera.focal_px or np.linalg.norm(vectors, axis=-1).max() > _UNIQUE_TURN:
            return Rotations(self.rotations, camera)
        zoom = self.camera.focal_px / camera.focal_px
        return Rotations(rotation_matrices(vectors * [zoom, zoom, 1.0]), camera)


class RotationAdjustment(Adjustment[Rotations]):
    """The least-squares problem of a graph whose nodes are rotations of one camera.

    The unknowns of a node are a rotation vector in its own frame. Those of the camera that are not given are shared: the
    logarithm of its focal length, and the distortion of its lens. With another focal length, pixels move and are bent alike.
    """

    _n_node = 3

    def __init__(self, problem: Problem, assumed: Camera, unknown: tuple[int, ...]) -> None:
        """Set up the problem, whose homographies are those of ideal pixels of the `assumed` camera.

        Unknown may be 0 for the focal length, and 1 to 4 for k1, k2, p1, p2.
        """
        super().__init__(problem, n_shared=len(unknown))
        self._assumed, self._unknown = assumed, unknown
        self._shifts: dict[Rotations, FloatArray] = {}  # of the last state, and of states near it

    def of(self, problem: Problem) -> RotationAdjustment:
        """Return the same for other pairs."""
        return RotationAdjustment(problem, self._assumed, self._unknown)

    @cached_property
    def _lens(self) -> LensShift:
        return LensShift.of(self._frame_shape, self._motions, self._noise.weights)

    def homographies(self, state: Rotations) -> FloatArray:
        """Return K R K^-1, of determinant 1: (N, 3, 3)."""
        return state.camera.homographies(state.rotations)

    def relative(self, state: Rotations) -> FloatArray:
        """Return K R K^-1 of the rotation between the nodes of each edge: (E, 3, 3)."""
        between = np.swapaxes(state.rotations[self._fixed], -1, -2) @ state.rotations[self._moving]
        return state.camera.homographies(between)

    def changed(self, state: Rotations, nodes: FloatArray, shared: FloatArray) -> Rotations:
        """Rotate each node, and change the camera."""
        rotated = Rotations(state.rotations @ rotation_matrices(nodes * (self._half / state.camera.focal_px)), state.camera)
        for index, step in zip(self._unknown, shared * self._units(state.camera), strict=True):
            rotated = self._changed(rotated, index, float(step))
        return rotated

    def mapped_corners(self, state: Rotations) -> FloatArray:
        """Return where the corners are seen: (E, 4, 2) px.

        If pixels were undistorted with the wrong lens, no homography holds exactly; it is the one that fits the patches best.
        """
        mapped = super().mapped_corners(state)
        return mapped + self._lens.of_corners(self._shift(state)) if self._bends(state) else mapped

    def generators(self, state: Rotations) -> FloatArray:
        """Return the derivatives by rotations that move the middle of the frame by about half its side: (3, 3, 3)."""
        return state.camera.homographies(ROTATION_AXES) * (self._half / state.camera.focal_px)

    def information(self, state: Rotations, blocks: FloatArray) -> FloatArray:
        """Convert to information on rotation vectors, in radians: (N, 3, 3)."""
        return blocks * (state.camera.focal_px / self._half) ** 2

    def shared_slopes(self, state: Rotations) -> FloatArray:
        """Return the derivatives of the corners by what is unknown of the camera: (E, 8, s)."""
        here = self.mapped_corners(state).reshape(-1, 8)
        return np.stack([(self.mapped_corners(each).reshape(-1, 8) - here) / _STEP for each in self._nearby(state)], axis=-1)

    def shared_errors(self, state: Rotations) -> FloatArray:
        """Return how the corners of each frame move on the plane of the anchor by what is unknown of the camera: (N, 8, s)."""
        back, here = np.linalg.inv(self.homographies(state)), state.camera.ideal(self._corners)
        found = []
        for each in self._nearby(state):
            there = transform_points(back @ self.homographies(each), each.camera.ideal(self._corners))
            found.append((there - here).reshape(-1, 8) / _STEP)
        return np.stack(found, axis=-1)

    @remembered
    def _nearby(self, state: Rotations) -> list[Rotations]:
        """Return the state after a small step of each unknown of the camera."""
        self._shifts = {key: shift for key, shift in self._shifts.items() if key is state}
        units = self._units(state.camera)
        return [self._changed(state, index, _STEP * unit) for index, unit in zip(self._unknown, units, strict=True)]

    def shifted_patches(self, state: Rotations) -> FloatArray | float:
        """Return how the lens shifts patches: see `Adjustment`."""
        return self._shift(state).reshape(len(self._motions), -1, 2) if self._bends(state) else 0.0

    def _bends(self, state: Rotations) -> bool:
        return state.camera.distorts or self._assumed.distorts

    def _shift(self, state: Rotations) -> FloatArray:
        """Return how patches are shifted if this is the camera: (E, 2 P)."""
        if state not in self._shifts:
            self._shifts[state] = self._lens.of_patches(self.relative(state), state.camera, self._assumed)
        return self._shifts[state]

    def _unexplained(self, state: Rotations) -> FloatArray:
        return self._lens.unexplained(self._shift(state) if self._bends(state) else None)

    @property
    def _finds_lens(self) -> bool:
        return any(index > 0 for index in self._unknown)

    def deviance(self, state: Rotations, weights: FloatArray) -> float:
        """Compare with other models: see `Adjustment`. A lens also explains why patches lie beside homographies.

        A unit of roll is an angle here, and one of the shift of a corner there.
        """
        before = float((self._lens.unexplained() ** 2).sum()) if self._finds_lens or self._assumed.distorts else 0.0
        if self._assumed.distorts and not self._finds_lens:
            before -= float((self._unexplained(state) ** 2).sum())
        units = 2 * (self._n_nodes - 1) * float(np.log(state.camera.focal_px / self._half))
        found = super().deviance(state, weights) - before + units
        if 1 not in self._unknown:
            return found
        k1, scale = float(state.camera.distortion[0]), float(_PRIOR_DISTORTION[0])
        std = _PRIOR_BEND * float(self._units(state.camera)[self._unknown.index(1)])
        return found + float(2 * np.log1p((k1 / scale) ** 2) - (k1 / std) ** 2 + 2 * np.log(scale / std) + np.log(np.pi / 2))

    @remembered
    def prior(self, state: Rotations) -> Prior:
        """Return what is known before: a focal length of some sides of a frame, a small distortion, and where patches lie."""
        units = self._units(state.camera)
        away = np.array([_away(state.camera, index, 2 * self._half) for index in self._unknown])
        stds = np.array([_PRIOR_STD, *_PRIOR_DISTORTION])[list(self._unknown)]
        stds = np.where(np.array(self._unknown) == 1, _PRIOR_BEND * units, stds)
        known, of_known = away / stds, np.diag(units / stds)
        log_variances = 2 * float(np.log(stds / units).sum())
        if self._finds_lens:
            left = self._unexplained(state)
            of_left = np.stack([(self._unexplained(each) - left) / _STEP for each in self._nearby(state)], axis=-1)
            known, of_known = np.concatenate([known, left]), np.concatenate([of_known, of_left])
        return Prior(known, self._of_shared(of_known), log_variances)

    def _units(self, camera: Camera) -> FloatArray:
        """Return the change of each unknown that moves the ends of a frame by about half its side."""
        end = float(np.hypot(*self._frame_shape)) / 2 / camera.focal_px
        return np.array([1.0, end**-2, end**-4, end**-1, end**-1])[list(self._unknown)]

    def std_camera(self, state: Rotations, shared: FloatArray) -> FloatArray:
        """Return the expected errors of the focal length, in px, and of k1, k2, p1 and p2: (5,), 0 for what is given."""
        errors = np.zeros((5, shared.shape[1]))
        errors[list(self._unknown)] = shared * self._units(state.camera)[:, None]
        errors[1:] += (self._bent_alike * state.camera.distortion)[:, None] * errors[0]
        errors[0] *= state.camera.focal_px
        return np.asarray(np.sqrt((errors**2).mean(axis=1)))

    @property
    def _bent_alike(self) -> FloatArray:
        """The powers of the focal length with which the distortion grows: (4,), 0 for what is given."""
        return np.asarray(_POWERS * np.isin(np.arange(1, 5), self._unknown))

    def _changed(self, state: Rotations, index: int, step: float) -> Rotations:
        """Change the logarithm of the focal length (index 0), evenly in 1 / f^2, or another number of the distortion."""
        camera = state.camera
        if index == 0:
            zoom = max(1 - 2 * step, _MOST_ZOOM**-2) ** -0.5
            camera = replace(_with_focal(camera, camera.focal_px * zoom), distortion=camera.distortion * zoom**self._bent_alike)
            return state.seen_by(camera)
        distortion = camera.distortion.copy()
        distortion[index - 1] += step
        return Rotations(state.rotations, replace(camera, distortion=distortion))

    def likeliest_camera(self, camera: Camera) -> Camera:
        """Return the camera with the focal length that explains the edges best, each by itself."""
        candidates = [_with_focal(camera, length * 2 * self._half) for length in _FOCAL_LENGTHS]
        return min(candidates, key=self._cost_of)

    def _cost_of(self, camera: Camera) -> float:
        chosen = np.unique(np.linspace(0, len(self._moving) - 1, _MOST_TRIED).astype(int))
        whitening, targets = self._whitening[chosen], self._targets[chosen]
        rotations = rotations_between(camera, self._corners, targets)
        moves = camera.homographies(ROTATION_AXES)

        def residuals_of(mapped: FloatArray) -> FloatArray:
            away = transform_points(mapped, self._corners) - targets
            return np.asarray(np.einsum("eij,ej->ei", whitening, away.reshape(-1, 8)))

        for _ in range(2):
            mapped = camera.homographies(rotations)
            slope = whitening @ slopes(mapped @ self._rows, mapped[:, None] @ (moves @ self._rows))
            gradient = np.einsum("eij,ei->ej", slope, residuals_of(mapped))
            step = -np.linalg.solve(np.swapaxes(slope, -1, -2) @ slope, gradient[..., None])
            rotations = rotations @ rotation_matrices(step[..., 0])
        residuals = residuals_of(camera.homographies(rotations))
        squares = (residuals**2).sum(axis=1)
        return float(np.log1p(squares / 8).sum() + (_away(camera, 0, 2 * self._half) / _PRIOR_STD) ** 2)


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    return replace(camera, matrix=camera_matrix(focal_px, camera.centre_px))


def _away(camera: Camera, index: int, side_px: float) -> float:
    """Return how far a number of a camera is from where it may be expected."""
    return float(np.log(camera.focal_px / (_PRIOR_FOCAL * side_px)) if index == 0 else camera.distortion[index - 1])


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
