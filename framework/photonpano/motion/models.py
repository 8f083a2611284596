"""Models of the motion, any homographies or rotations of one camera; and the pairs that agree with one motion of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import Camera, camera_matrix, generators, parameters, patch_centres, slopes, transform_points
from photonpano.motion.planar import PlanarName
from photonpano.values import FloatArray, Located, Patches

# Initial focal length, in longer sides of a frame.
_FIRST_FOCAL = 3.0
_NO_LENS = (0.0, 0.0, 0.0, 0.0)
_LENS = (None, None, 0.0, 0.0)  # what "auto" finds of a lens: k1 and k2
SAME_LENS_PX = 0.05  # largest difference of what two lenses do to a frame that does not matter
_FAR_FOCAL = 1e4  # that of a camera whose turns shift and roll the image
# Residuals of patches, in px, within which they agree: all of them at first, and then those of the background alone
# (graduated non-convexity, Black and Rangarajan 1996).
_TOLERANCES_PX = (2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25, 0.18)
_LEAST_TOLERANCE = 0.5  # of the usual photon noise of patches: below that, chance decides which of them agree
_CERTAIN = 0.5  # least error of a patch beside photon noise, as a share of the tolerance
_TELLING = 48  # patches of most pairs that must show something
_FEWEST = 8.0  # patches, by their weights, that determine the motion of a pair
_UNCERTAIN = 1e-4  # factor of the information of a pair that has fewer
_FAR, _FAR_PX = 4.0, 0.5  # standard deviations, and px, beyond which a patch contradicts a motion
_ALIKE_PX = 0.1  # error of patches beside photon noise
APART = 9.0  # mean square of the residuals of a patch that does not follow the motion, in variances
_RESTS = 0.5  # share of patches that move as what rests, more than those that move the other way
_LINE_STEPS = 10  # with weights of Geman and McClure
_DAMPING, _TINY = 1e-6, 1e-12
_AT_ONCE = 256  # pairs whose patches are weighed together: some 10 MB


ModelName = Literal["auto", "translation", "euclidean", "similarity", "affine", "homography", "rotation"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionModel:
    """The model of the motion of a camera."""

    kind: ModelName = "homography"  # "auto" for the one that the pairs support
    focal_px: float | None = None  # of the camera; None if it is to be found
    centre_px: tuple[float, float] | None = None  # (x, y) of its principal point; None for the middle of the frames
    # k1, k2, p1, p2 of its lens; None for those that are to be found
    distortion: tuple[float | None, float | None, float | None, float | None] = (0.0, 0.0, 0.0, 0.0)
    known: Camera | None = None  # the camera that the level before has found
    doubts_lens: bool = False  # whether the lens of that camera was found without being asked for
    rough: bool = False  # whether a level of larger exposures follows, which asks about the lens again
    layered: bool = False  # whether frames are known to show more than a background that follows the camera

    @property
    def unknown(self) -> tuple[int, ...]:
        """Which numbers of the camera are to be found: 0 for the focal length, 1 to 4 for k1, k2, p1, p2."""
        return tuple(index for index, number in enumerate((self.focal_px, *self.distortion)) if number is None)

    @property
    def name(self) -> str:
        """Its name, such as "rotation with a lens" where the distortion is to be found."""
        return f"{self.kind} with a lens" if self.finds_lens else self.kind

    @property
    def planar(self) -> PlanarName:
        """The group of its homographies; any but those of a rotation have one."""
        if self.kind == "rotation" or self.kind == "auto":
            raise ValueError(f"{self.kind} is no planar model")
        return self.kind

    @property
    def rotations(self) -> tuple[MotionModel, ...]:
        """The rotations that are compared: without a lens, and with one, unless that is known or asked for."""
        rotation = replace(self, kind="rotation")
        if not self.doubts_lens and (any(self.distortion) or self.finds_lens):
            return (rotation,)
        return replace(rotation, distortion=_NO_LENS), replace(rotation, distortion=_LENS)

    @property
    def has_rivals(self) -> bool:
        """Whether the pairs choose the model: that of "auto", or without a lens that was found without being asked for."""
        return self.kind == "auto" or (self.doubts_lens and self.finds_lens)

    @property
    def finds_lens(self) -> bool:
        """Whether the distortion of the lens is to be found."""
        return any(index > 0 for index in self.unknown)

    def camera(self, frame_shape: tuple[int, int]) -> Camera:
        """Return what is known of the camera so far; what is not begins at 3 sides of a frame, and without distortion."""
        if self.known is not None:
            return Camera(self.known.matrix) if self.doubts_lens and not self.finds_lens else self.known
        middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
        matrix = camera_matrix(self.focal_px or _FIRST_FOCAL * max(frame_shape), self.centre_px or middle)
        return Camera(matrix, np.array([number or 0.0 for number in self.distortion]))

    def seen_by(self, frame_shape: tuple[int, int]) -> Camera:
        """Return the camera by whose lens frames are warped: without distortion as long as its focal length is unknown."""
        camera = self.camera(frame_shape)
        if self.known is None and self.focal_px is None:
            return Camera(camera.matrix)
        return self.known or camera

    def turning_camera(self, frame_shape: tuple[int, int]) -> Camera | None:
        """Return the camera that locators may use: one that only turns, of a focal length that is given or was found."""
        if self.known is None and self.focal_px is None:
            if self.kind not in ("auto", "translation", "euclidean"):
                return None
            middle = (frame_shape[1] - 1) / 2, (frame_shape[0] - 1) / 2
            return Camera(camera_matrix(_FAR_FOCAL * max(frame_shape), middle))
        return self.camera(frame_shape) if self.kind in ("rotation", "auto") else None

    def knowing(self, camera: Camera | None) -> MotionModel:
        """Return the model after a level that has found the camera, or None.

        Frames are then seen through its lens, if it has one: "auto" then compares rotations alone.
        """
        if camera is None:
            return self
        if self.kind == "auto" and camera.distorts:
            doubts = not self.finds_lens and not any(self.distortion)
            return replace(
                self, kind="rotation", distortion=_LENS if doubts else self.distortion, known=camera, doubts_lens=doubts
            )
        return replace(self, known=camera)


HOMOGRAPHIES = MotionModel()


def tolerances_px(motions: Sequence[Located]) -> tuple[float, ...]:
    """Return the residuals within which patches agree, coarse to fine, as far as their noise lets them agree."""
    information = [each.patches.information for each in motions if each.patches is not None]
    stds_px = [np.sqrt(np.trace(_covariances(each[each[:, 0, 0] > 0]), axis1=1, axis2=2) / 2) for each in information]
    least_px = _LEAST_TOLERANCE * float(np.median(np.concatenate(stds_px))) if stds_px else 0.0
    return tuple(each for each in _TOLERANCES_PX if each in _TOLERANCES_PX[:1] or each >= least_px)


def agreeing(motions: Sequence[Located], residuals: FloatArray, tolerance_px: float, shape: tuple[int, int]) -> list[Located]:
    """Return the motions of pairs by the patches that agree with a motion of the camera.

    `residuals` (E, P, 2) are what that leaves of where patches lie, in px of frames of (height, width).
    """
    weights, found = _weights(residuals, tolerance_px), list(motions)
    patched = [index for index, each in enumerate(motions) if each.patches is not None and each.information is not None]
    for some in (patched[start : start + _AT_ONCE] for start in range(0, len(patched), _AT_ONCE)):
        pairs = _by_patches([motions[index] for index in some], weights[some], tolerance_px, shape)
        for index, motion in zip(some, pairs, strict=True):
            found[index] = motion
    return found


def agreed_share(motions: Sequence[Located], residuals: FloatArray, tolerance_px: float) -> float:
    """Return the share of the patches that show something and agree with a motion, by the weights that they have then."""
    weights = _weights(residuals, tolerance_px)
    patches = [each.patches for each in motions]
    shown = [each[seen.information[:, 0, 0] > 0] for each, seen in zip(weights, patches, strict=True) if seen is not None]
    return float(np.concatenate(shown).mean()) if shown else 0.0


def _weights(residuals: FloatArray, tolerance_px: float) -> FloatArray:
    """Return the weights of Geman and McClure: (E, P)."""
    return np.asarray(1 / (1 + (residuals**2).sum(axis=-1) / (2 * tolerance_px**2)) ** 2)


def contradicting(motions: Sequence[Located], residuals: FloatArray) -> float:
    """Return the share of the patches that lie elsewhere than a motion lets expect; 0 if too few show anything to tell."""
    shown = np.array([motion.patches is not None for motion in motions])
    information = np.array([motion.patches.information for motion in motions if motion.patches is not None])
    if not len(information) or np.median((seen := information[..., 0, 0] > 0).sum(axis=1)) < _TELLING:
        return 0.0
    information, left = information[seen], residuals[shown][seen]
    variances = np.trace(_covariances(information), axis1=1, axis2=2)
    return float(((left**2).sum(axis=-1) > _FAR**2 * variances + _FAR_PX**2).mean())


def _covariances(information: FloatArray) -> FloatArray:
    """Return the inverses of (..., 2, 2) information; what nothing is known of varies by much, but not without end."""
    traces = np.trace(information, axis1=-2, axis2=-1)
    return np.linalg.inv(information + np.maximum(_DAMPING * traces, _TINY)[..., None, None] * np.eye(2))


def layers(pairs: NDArray[np.integer], motions: Sequence[Located], residuals: FloatArray, n_nodes: int) -> FloatArray:
    """Return the mean squares of the residuals of the patches of each node, in variances: (n_nodes, P); 0 if not known.

    `pairs` (E, 2) are the moving and the fixed node of each pair; patches are those of the moving one.
    """
    squares, numbers = np.zeros((2, n_nodes, residuals.shape[1]))
    for (moving, _), motion, left in zip(pairs, motions, residuals, strict=True):
        if motion.patches is not None:
            seen = motion.patches.information[:, 0, 0] > 0
            limited = _covariances(motion.patches.information[seen]) + _ALIKE_PX**2 * np.eye(2)
            squares[moving, seen] += (
                np.einsum("pi,pi->p", left[seen], np.linalg.solve(limited, left[seen, :, None])[..., 0]) / 2
            )
            numbers[moving, seen] += 1
    return np.asarray(squares / np.maximum(numbers, 1))


def travelled(
    pairs: NDArray[np.integer], motions: Sequence[Located], residuals: FloatArray, layers: FloatArray, places: FloatArray
) -> float:
    """Return how far what is near moves beside the background from the first node to the last, px, as the camera travels.

    It is 0 where what does not follow the turns of the camera does not rest, either: beside the background, what rests moves by
    its inverse depth along lines through one point of a frame, all of it towards that point, or away. `places` (E, P, 2) are
    where patches lie, in focal lengths from the centre of the fixed frame.
    """
    steps, aside = [], list[FloatArray]()
    for (moving, fixed), motion, left, there in zip(pairs, motions, residuals, places, strict=True):
        apart = layers[moving] > APART
        if motion.patches is not None and (apart := apart & (motion.patches.information[:, 0, 0] > 0)).sum() >= _FEWEST:
            covariances = _covariances(motion.patches.information[apart])
            sizes = np.sqrt(np.maximum((left[apart] ** 2).sum(axis=-1) - np.trace(covariances, axis1=1, axis2=2), 0))
            steps.append(float(np.median(sizes)) / abs(moving - fixed))
            aside.append(_along_lines(there[apart], left[apart], covariances + _ALIKE_PX**2 * np.eye(2)))
    rests = bool(aside) and float(np.concatenate(aside).mean()) > _RESTS
    return float(np.median(steps)) * (len(layers) - 1) if rests else 0.0


def _along_lines(places: FloatArray, shifts: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return which shifts (P, 2) at places (P, 2) lie along lines through one point: 1 for those of most, -1 for the opposite.

    It is 0 for those that do not.
    """
    x, y = shifts.T
    across, weights = np.stack([-y, x, y * places[:, 0] - x * places[:, 1]], axis=1), np.ones(len(shifts))
    for _ in range(_LINE_STEPS):
        point = np.linalg.eigh((across * weights[:, None]).T @ across)[1][:, 0]
        lines = point[:2] - point[2] * places
        beside = np.stack([-lines[:, 1], lines[:, 0]], axis=1)
        squares = (across @ point) ** 2 / np.maximum(np.einsum("pi,pij,pj->p", beside, covariances, beside), _TINY)
        weights = 1 / (1 + squares / _FAR) ** 2 / np.maximum((lines**2).sum(axis=1), _TINY)
    sides = np.sign((shifts * lines).sum(axis=1))
    return np.asarray(np.where(squares < _FAR**2, sides * np.sign(np.median(sides)), 0))


def _by_patches(motions: Sequence[Located], weights: FloatArray, tolerance_px: float, shape: tuple[int, int]) -> list[Located]:
    """Return the homographies that patches with these weights, (E, P), show, with their information."""
    middles, moves = patch_centres(shape), generators(shape)
    observed = np.array([each.homography for each in motions])
    patches = [each.patches for each in motions if each.patches is not None]
    shifts, known = np.array([each.shifts for each in patches]), np.array([each.information for each in patches])
    there = observed @ np.concatenate([middles, np.ones((len(middles), 1))], axis=1).T
    by_points = slopes(there, moves @ there[:, None])
    shown = known[..., 0, 0] > 0
    limited = _covariances(known) + (_CERTAIN * tolerance_px) ** 2 * np.eye(2)
    information = np.where(shown[..., None, None], weights[..., None, None] * np.linalg.inv(limited), 0)
    weighted = (information @ by_points.reshape(*shown.shape, 2, 8)).reshape(by_points.shape)
    normal = np.swapaxes(by_points, 1, 2) @ weighted
    normal += _DAMPING * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(8)
    few = (weights * shown).sum(axis=1) < _FEWEST  # such pairs keep their homographies
    normal[few] = np.eye(8)
    steps = np.linalg.solve(normal, np.swapaxes(weighted, 1, 2) @ shifts.reshape(len(shifts), -1, 1))[..., 0]
    homographies = observed + np.einsum("ei,ijk->ejk", steps, moves) @ observed
    homographies /= homographies[:, 2:, 2:]
    changed = moves @ homographies[:, None]
    by_steps = parameters(np.eye(3) + changed - homographies[:, None] * changed[..., 2:, 2:])
    to_steps = np.linalg.inv(np.swapaxes(by_steps, 1, 2))
    totals = np.swapaxes(to_steps, 1, 2) @ normal @ to_steps
    left = transform_points(observed, middles) + shifts - transform_points(homographies, middles)
    left = np.where(shown[..., None], left, 0)
    found = []
    for index, motion in enumerate(motions):
        if few[index]:
            assert motion.information is not None
            kept = Patches(shifts[index], information[index])
            found.append(replace(motion, information=motion.information * _UNCERTAIN, patches=kept))
        else:
            kept = Patches(left[index], information[index])
            found.append(replace(motion, homography=homographies[index], information=totals[index], patches=kept))
    return found
