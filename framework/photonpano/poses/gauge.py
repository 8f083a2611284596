"""The gauge of poses: origin, directions and scale of a world are free, and are chosen here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photonpano.errors import LocationError
from photonpano.values import FloatArray, PoseEstimate, ScenePoints


def centres(camera_from_world: FloatArray) -> FloatArray:
    """Return the positions of cameras in the world, -R^T t: (..., 3, 4) to (..., 3)."""
    return np.asarray(-np.einsum("...ji,...j->...i", camera_from_world[..., :3], camera_from_world[..., 3]))


def path_length(camera_from_world: FloatArray) -> float:
    """Return the length of the path of (T, 3, 4) poses, without those that are NaN."""
    known = centres(camera_from_world[np.isfinite(camera_from_world).all(axis=(1, 2))])
    return float(np.linalg.norm(np.diff(known, axis=0), axis=1).sum())


def in_standard_world(estimate: PoseEstimate) -> PoseEstimate:
    """Move the world so that the first located camera is its origin and looks along z, and the path has the length 1.

    Raises:
        LocationError: the camera does not travel, so that there is no scale.
    """
    length = path_length(estimate.camera_from_world)
    if not length > 0:
        raise LocationError(
            "the camera does not travel: all located frames have one position; if it turns, leave out `pose` and set "
            "motion: {model: rotation}"
        )
    first = estimate.camera_from_world[int(np.argmax(estimate.located))]

    def moved(camera_from_world: FloatArray) -> FloatArray:
        rotation = camera_from_world[..., :3] @ first[:, :3].T
        shift = (camera_from_world[..., 3] - rotation @ first[:, 3]) / length
        return np.concatenate([rotation, shift[..., None]], axis=-1)

    positions = (estimate.points.positions @ first[:, :3].T + first[:, 3]) / length
    return replace(
        estimate,
        camera_from_world=moved(estimate.camera_from_world),
        std_position=estimate.std_position / length,
        points=ScenePoints(positions, estimate.points.flux),
        views=tuple(replace(view, camera_from_world=moved(view.camera_from_world)) for view in estimate.views),
    )
