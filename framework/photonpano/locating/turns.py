"""Information of a pair of exposures on a rotation of the camera: three of the eight parameters of a homography."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photonpano.geometry import ROTATION_AXES, corners, jacobian, parameters
from photonpano.values import FloatArray, Homography

# Expected error of a corner in the directions that a turn does not reach, in sides of the image: as good as unknown.
_UNKNOWN = 1.0


class TurnInformation(NamedTuple):
    """Information of a pair of exposures on the rotation between them."""

    # (8, 8) inverse covariance of p1..p8 of the homography. Only a turn is known: what else could have happened to the image is
    # uncertain by a whole image.
    information: FloatArray
    std_px: float  # expected error of a corner if the camera has only turned


def turn_slopes(homography: Homography, camera_matrix: FloatArray) -> FloatArray:
    """Return the derivatives of p1..p8 of a homography by a rotation vector of the camera whose pixels it maps: (8, 3).

    Args:
        homography: (3, 3) with h33 = 1.
        camera_matrix: (3, 3) K; a small rotation R before the homography makes it H K R K^-1.
    """
    changes = homography @ camera_matrix @ ROTATION_AXES @ np.linalg.inv(camera_matrix)
    return np.asarray(parameters(changes - changes[:, 2:, 2:] * homography + np.eye(3)).T)


def information_on_turn(
    information: FloatArray, homography: Homography, camera_matrix: FloatArray, shape: tuple[int, int]
) -> TurnInformation:
    """Restrict information on a homography to the three unknowns of a turn, at the turn that fits the exposures best.

    Convention:
        The map takes pixels of the moving image to pixels of the fixed one; points are (x, y), integers are pixel centres.

    Args:
        information: (8, 8) inverse covariance of p1..p8, as if all were estimated.
        homography: (3, 3) K R K^-1, scaled to h33 = 1.
        camera_matrix: (3, 3) K, in px of the images.
        shape: (height, width) of the images.

    Raises:
        numpy.linalg.LinAlgError: the images do not determine a turn.
    """
    basis, to_corners = turn_slopes(homography, camera_matrix), jacobian(homography, corners(shape)).reshape(8, 8)
    rows = information @ basis
    covariance = np.linalg.inv(basis.T @ rows)
    weak = to_corners.T @ to_corners / (_UNKNOWN * max(shape)) ** 2
    moves = to_corners @ basis
    return TurnInformation(rows @ covariance @ rows.T + weak, float(np.sqrt(np.trace(moves @ covariance @ moves.T) / 4)))
