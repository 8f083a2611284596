"""The planar models of motion, groups of homographies from translations to all of them, and the motion graph of one."""

from __future__ import annotations

from typing import Literal

import numpy as np

from photonpano.geometry import corners, generators, normalised, parameters, transform_points
from photonpano.motion.adjustment import Adjustment, Problem
from photonpano.values import FloatArray, Homography

PlanarName = Literal["translation", "euclidean", "similarity", "affine", "homography"]

# The small motions of each model, by what they change of p1..p8 in unit coordinates.
_MOVED: dict[PlanarName, tuple[dict[int, float], ...]] = {
    "translation": ({4: 1}, {5: 1}),
    "euclidean": ({4: 1}, {5: 1}, {1: 1, 2: -1}),
    "similarity": ({4: 1}, {5: 1}, {1: 1, 2: -1}, {0: 1, 3: 1}),
    "affine": tuple({index: 1.0} for index in range(6)),
    "homography": tuple({index: 1.0} for index in range(8)),
}
PLANAR_NAMES: tuple[PlanarName, ...] = tuple(_MOVED)
_TERMS = 12  # of the exponential series, which is exact for steps of a frame


def basis_of(model: PlanarName) -> FloatArray:
    """Return the small motions of a model: (8, k) changes of p1..p8 in unit coordinates."""
    basis = np.zeros((8, len(_MOVED[model])))
    for column, changes in enumerate(_MOVED[model]):
        for row, change in changes.items():
            basis[row, column] = change
    return basis


def moved(homographies: FloatArray, steps: FloatArray, basis: FloatArray, frame_shape: tuple[int, int]) -> Homography:
    """Return homographies after a motion of each frame, (N, k) along the (8, k) basis: it stays within the group."""
    change = np.einsum("nk,pk,pij->nij", steps, basis, generators(frame_shape))
    term = total = np.broadcast_to(np.eye(3), change.shape)
    for order in range(1, _TERMS + 1):
        term = term @ change / order
        total = total + term
    return normalised(homographies @ total)


def nearest(model: PlanarName, homographies: Homography, frame_shape: tuple[int, int]) -> Homography:
    """Return the motions of a model that move the corners of a frame most like (N, 3, 3) homographies, by least squares."""
    if model == "homography":
        return homographies
    here, there = corners(frame_shape), transform_points(homographies, corners(frame_shape))
    middle, moved_middle = here.mean(axis=0), there.mean(axis=1)
    away, moved_away = here - middle, there - moved_middle[:, None]
    found = np.broadcast_to(np.eye(3), homographies.shape).copy()
    if model == "affine":
        found[:, :2, :2] = (
            np.linalg.lstsq(away, np.moveaxis(moved_away, 0, -1).reshape(4, -1), rcond=None)[0]
            .reshape(2, 2, -1)
            .transpose(2, 1, 0)
        )
    elif model != "translation":
        # As complex numbers, a roll and a zoom are one factor.
        first, second = away @ [1, 1j], moved_away @ [1, 1j]
        factor = second @ first.conj() / (np.abs(first) ** 2).sum()
        if model == "euclidean":
            factor = factor / np.abs(factor)
        found[:, 0, 0], found[:, 0, 1] = factor.real, -factor.imag
        found[:, 1, 0], found[:, 1, 1] = factor.imag, factor.real
    found[:, :2, 2] = moved_middle - np.einsum("nij,j->ni", found[:, :2, :2], middle)
    return found


class PlanarAdjustment(Adjustment[FloatArray]):
    """The least-squares problem of a graph of homographies of a planar model; its state is these, (N, 3, 3) with h33 = 1.

    The unknowns of a node are those of a small motion of its own frame, in coordinates of about unit size.
    """

    def __init__(self, problem: Problem, model: PlanarName) -> None:
        """Set up the problem."""
        super().__init__(problem)
        self._basis = basis_of(model)

    @property
    def _n_node(self) -> int:
        return int(self._basis.shape[1])

    def homographies(self, state: FloatArray) -> FloatArray:
        """Return the state."""
        return state

    def changed(self, state: FloatArray, nodes: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the homographies after a step; nothing is shared."""
        del shared
        return moved(state, nodes, self._basis, self._frame_shape)

    def anchored(self, state: FloatArray) -> FloatArray:
        """Return the homographies, of which the anchor's is the identity."""
        state[self._anchor] = np.eye(3)
        return state

    def generators(self, state: FloatArray) -> FloatArray:
        """Return those of the model in unit coordinates: (k, 3, 3)."""
        del state
        return np.asarray(np.einsum("pk,pij->kij", self._basis, generators(self._frame_shape)))

    def information(self, state: FloatArray, blocks: FloatArray) -> FloatArray:
        """Convert (N, k, k) information on changes of nodes to that on p1..p8 of their homographies.

        What the model does not move is as sure as all that it does together.
        """
        back = np.linalg.pinv(self._basis)
        fixed = np.eye(8) - self._basis @ back
        blocks = back.T @ blocks @ back + np.trace(blocks, axis1=1, axis2=2)[:, None, None] * fixed
        changed = state[:, None] @ generators(self._frame_shape)
        slopes = changed - state[:, None] * changed[..., 2:, 2:]
        to_parameters = parameters(np.eye(3) + slopes).transpose(0, 2, 1)
        to_change = np.linalg.inv(to_parameters)
        return np.asarray(to_change.transpose(0, 2, 1) @ blocks @ to_change)
