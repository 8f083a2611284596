"""Compare the poses that two halves of the points of a reconstruction give by themselves."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from photonpano_colmap.posing.path import positions_of
from photonpano_colmap.reversal import adjust_model

_FEWEST = 3  # positions that determine a similarity


@dataclass(frozen=True, slots=True)
class Halves:
    """Expected errors of poses from half of the points, root mean square.

    Keypoints of a track err alike, from blur and at the edges of things, which residuals do not show: so the poses from all
    points are hardly better than these.
    """

    std_position: float  # in units of the world
    std_rotation: float  # in radians, after the best common rotation


_UNKNOWN = Halves(np.inf, np.inf)


def compared_halves(found: pycolmap.Reconstruction, finds_focal: bool) -> Halves:
    """Adjust the images of a reconstruction to every second point, and to the others; compare both, aligned."""
    halves = [copy.deepcopy(found) for _ in range(2)]
    for number, half in enumerate(halves):
        for identifier in sorted(half.points3D)[number::2]:
            half.delete_point3D(identifier)
        adjust_model(half, finds_focal)
        if not half.num_points3D():  # as of a camera that only turns, whose points lie anywhere
            return _UNKNOWN
    images = sorted(set(halves[0].reg_image_ids()) & set(halves[1].reg_image_ids()))
    first, second = (np.array([half.images[each].cam_from_world().matrix() for each in images]) for half in halves)
    aligned = pycolmap.estimate_sim3d(positions_of(first), positions_of(second)) if len(images) >= _FEWEST else None
    if aligned is None:
        return _UNKNOWN
    apart = positions_of(first) @ aligned.rotation.matrix().T * aligned.scale + aligned.translation - positions_of(second)
    worlds = Rotation.from_matrix(np.swapaxes(first[:, :, :3], 1, 2) @ second[:, :, :3])
    turned = (worlds * worlds.mean().inv()).magnitude()
    # Both halves err, by chance.
    return Halves(*(float(np.sqrt(np.mean(each**2) / 2)) for each in (np.linalg.norm(apart, axis=1), turned)))
