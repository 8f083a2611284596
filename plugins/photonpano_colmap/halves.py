"""Compare the poses that two halves of the points of a reconstruction give by themselves."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from photonpano_colmap.posing.path import positions_of
from photonpano_colmap.reversal import adjust_model

_CELLS = 0.06, 0.12  # sides of the squares of two chessboards, in focal lengths
_FEWEST = 3  # positions that determine a similarity


@dataclass(frozen=True, slots=True)
class Halves:
    """Expected errors of poses from half of the points, root mean square.

    Keypoints of a track err alike, from blur and at the edges of things, which residuals do not show: so the poses from all
    points are hardly better than these.
    """

    std_position: float  # in units of the world
    std_rotation: float  # in radians, after the best common rotation


def compared_halves(found: pycolmap.Reconstruction, finds_focal: bool) -> Halves:
    """Adjust the images of a reconstruction to each half of its points; compare both, aligned.

    The halves are the black and the white squares of a chessboard that the image in the middle sees: neighbours err alike, so
    that they belong to one half. How far two halves are apart is chance, too, and less so as the mean of two boards.
    """
    squares = np.array([_compared(found, finds_focal, cell) for cell in _CELLS]) ** 2
    return Halves(*np.sqrt(squares.mean(axis=0)).tolist())


def _compared(found: pycolmap.Reconstruction, finds_focal: bool, cell: float) -> tuple[float, float]:
    """Return the expected errors of positions and rotations from the halves of a board; infinite where half has no poses."""
    places = sorted(found.reg_image_ids())
    middle = found.images[places[len(places) // 2]].cam_from_world()
    halves = [copy.deepcopy(found) for _ in range(2)]
    for number, half in enumerate(halves):
        for identifier, point in found.points3D.items():
            x, y, z = middle * point.xyz
            if (x / z // cell + y / z // cell) % 2 == number:
                half.delete_point3D(identifier)
        adjust_model(half, finds_focal)
        if not half.num_points3D():  # as of a camera that only turns, whose points lie anywhere
            return np.inf, np.inf
    images = sorted(set(halves[0].reg_image_ids()) & set(halves[1].reg_image_ids()))
    first, second = (np.array([half.images[each].cam_from_world().matrix() for each in images]) for half in halves)
    aligned = pycolmap.estimate_sim3d(positions_of(first), positions_of(second)) if len(images) >= _FEWEST else None
    if aligned is None:
        return np.inf, np.inf
    apart = positions_of(first) @ aligned.rotation.matrix().T * aligned.scale + aligned.translation - positions_of(second)
    worlds = Rotation.from_matrix(np.swapaxes(first[:, :, :3], 1, 2) @ second[:, :, :3])
    turned = (worlds * worlds.mean().inv()).magnitude()
    # Both halves err, by chance.
    squares = np.sum(apart**2, axis=1), turned**2
    return float(np.sqrt(np.mean(squares[0]) / 2)), float(np.sqrt(np.mean(squares[1]) / 2))
