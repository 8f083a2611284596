"""The motion graph of a camera that only turns: three unknowns a node, and a camera that all share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photonpano.geometry import Camera, apply, nearest_rotations, rotation_matrices, slopes
from photonpano.motion.adjustment import Adjustment
from photonpano.values import FloatArray, Located

_AXES = np.array(
    [[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float
)
"""Derivatives of a small rotation by its rotation vector: (3, 3, 3)."""
_ZOOM = np.diag([1.0, 1.0, 0.0])
"""Derivative of a camera's matrix by the logarithm of its focal length, in coordinates about the principal point."""
_FOCAL_LENGTHS = np.geomspace(0.2, 100, 49)
"""Focal lengths that are tried first, in sides of a frame."""
_PRIOR_FOCAL, _PRIOR_STD = 3.0, 2.0
"""What is known of the focal length before: its logarithm is that of 3 sides of a frame, give or take 2."""
_MOST_TRIED = 400
"""Edges by which the first focal length is chosen."""


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """The rotations of a camera.

    Attributes:
        rotations: (N, 3, 3) from the camera at each node to that at the anchor.
        camera: of all of them.
    """

    rotations: FloatArray
    camera: Camera


class RotationAdjustment(Adjustment[Turns]):
    """The least-squares problem of a graph whose nodes are rotations of one camera.

    The unknowns of a node are a rotation vector in its own frame; the logarithm of the focal length is shared unless it is
    given.
    """

    _n_node = 3

    def __init__(
        self,
        pairs: NDArray[np.integer],
        anchor: int,
        observed: FloatArray,
        motions: Sequence[Located],
        frame_shape: tuple[int, int],
        find_focal: bool,
    ) -> None:
        """Set up the problem: see `Adjustment`.

        Args:
            pairs: (E, 2).
            anchor: the node that does not turn.
            observed: (E, 3, 3).
            motions: of the edges.
            frame_shape: (height, width) of a frame.
            find_focal: whether the focal length is unknown.
        """
        super().__init__(pairs, anchor, observed, motions, frame_shape, n_shared=int(find_focal))

    def homographies(self, state: Turns) -> FloatArray:
        """Return K R K^-1, of determinant 1: (N, 3, 3)."""
        return state.camera.homographies(state.rotations)

    def relative(self, state: Turns) -> FloatArray:
        """Return K R K^-1 of the rotation between the nodes of each edge: (E, 3, 3)."""
        between = np.swapaxes(state.rotations[self._fixed], -1, -2) @ state.rotations[self._moving]
        return state.camera.homographies(between)

    def changed(self, state: Turns, nodes: FloatArray, shared: FloatArray) -> Turns:
        """Turn each node, and change the focal length."""
        camera = state.camera
        turned = state.rotations @ rotation_matrices(nodes * (self._half / camera.focal_px))
        if len(shared):
            camera = replace(camera, matrix=camera.matrix @ np.diag([*np.exp([shared[0]] * 2), 1.0]))
        return Turns(turned, camera)

    def generators(self, state: Turns) -> FloatArray:
        """Return the derivatives by rotations that move the middle of the frame by about half its side: (3, 3, 3)."""
        return state.camera.homographies(_AXES) * (self._half / state.camera.focal_px)

    def information(self, state: Turns, blocks: FloatArray) -> FloatArray:
        """Convert to information on rotation vectors, in radians: (N, 3, 3)."""
        return blocks * (state.camera.focal_px / self._half) ** 2

    def shared_slopes(self, state: Turns) -> FloatArray:
        """Return the derivatives of the corners by the logarithm of the focal length: (E, 8, 1)."""
        relative, zoom = self.relative(state), _zoom(state.camera)
        return slopes(relative @ self._rows, ((zoom @ relative - relative @ zoom) @ self._rows)[:, None])[..., : self._n_shared]

    def shared_errors(self, state: Turns) -> FloatArray:
        """Return how the corners of each frame move by the logarithm of the focal length: (N, 8, 1)."""
        homographies, zoom = self.homographies(state), _zoom(state.camera)
        moved = (np.linalg.solve(homographies, zoom @ homographies) - zoom) @ self._rows
        return slopes(np.broadcast_to(self._rows, moved.shape), moved[:, None])[..., : self._n_shared]

    def prior(self, state: Turns) -> tuple[FloatArray, FloatArray]:
        """Return what is known of the focal length before."""
        away = np.log(state.camera.focal_px / (_PRIOR_FOCAL * 2 * self._half))
        return np.array([away / _PRIOR_STD])[: self._n_shared], np.eye(self._n_shared) / _PRIOR_STD

    def start(self, homographies: FloatArray, camera: Camera) -> Turns:
        """Return the rotations nearest to the homographies of the nodes: (N, 3, 3)."""
        return Turns(nearest_rotations(camera.rotations(homographies)), camera)

    def likeliest_camera(self, camera: Camera) -> Camera:
        """Return the camera with the focal length that explains the edges best, each by itself."""
        candidates = [_with_focal(camera, length * 2 * self._half) for length in _FOCAL_LENGTHS]
        return min(candidates, key=self._misfit)

    def _misfit(self, camera: Camera) -> float:
        chosen = np.unique(np.linspace(0, len(self._moving) - 1, _MOST_TRIED).astype(int))
        whitening, targets = self._whitening[chosen], self._targets[chosen]
        here = np.broadcast_to(self._corners, targets.shape)
        rays = [_rays(camera, points) for points in (here, targets)]
        # Of the rotations that bring four directions to four others, the one of least squares (Kabsch 1976); then one step.
        rotations = nearest_rotations(np.swapaxes(rays[1], -1, -2) @ rays[0])
        moves = camera.homographies(_AXES)
        for _ in range(2):
            mapped = camera.homographies(rotations)
            by_turn = whitening @ slopes(mapped @ self._rows, mapped[:, None] @ (moves @ self._rows))
            residuals = np.einsum("eij,ej->ei", whitening, (apply(mapped, self._corners) - targets).reshape(-1, 8))
            step = -np.linalg.solve(
                np.swapaxes(by_turn, -1, -2) @ by_turn, np.einsum("eij,ei->ej", by_turn, residuals)[..., None]
            )
            rotations = rotations @ rotation_matrices(step[..., 0])
        residuals = np.einsum(
            "eij,ej->ei", whitening, (apply(camera.homographies(rotations), self._corners) - targets).reshape(-1, 8)
        )
        squares = (residuals**2).sum(axis=1)
        away = np.log(camera.focal_px / (_PRIOR_FOCAL * 2 * self._half)) / _PRIOR_STD
        return float(np.log1p(squares / 8).sum() + away**2)


def _zoom(camera: Camera) -> FloatArray:
    """Return dK/d(log f) K^-1: (3, 3)."""
    x, y = camera.centre_px
    return np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 0.0]])


def _with_focal(camera: Camera, focal_px: float) -> Camera:
    matrix = camera.matrix.copy()
    matrix[0, 0] = matrix[1, 1] = focal_px
    return replace(camera, matrix=matrix)


def _rays(camera: Camera, points: FloatArray) -> FloatArray:
    """Return the unit vectors in which ideal pixels look: (..., 2) to (..., 3)."""
    rays = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ np.linalg.inv(camera.matrix).T
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
