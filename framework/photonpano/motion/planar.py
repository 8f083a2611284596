"""The planar models of motion: groups of homographies, from translations to all of them."""

from __future__ import annotations

from typing import Literal

import numpy as np

from photonpano.geometry import corners, generators, normalised, transform_points
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
