"""What mergers of frames along a motion share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import Group, Source, Trajectory
from photonpano.geometry import inverse, rescaling
from photonpano.merging import Chunk, PhotonSum, accumulate


def scaled_shape(frame_shape: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return the (height, width) of an exposure."""
    height, width = frame_shape
    return max(1, round(height * scale)), max(1, round(width * scale))


def summed_as_they_lie(source: Source, group: Group, scale: float) -> PhotonSum:
    """Sum the frames of a group while no motion is known."""
    still = Chunk(group.span, np.eye(3))
    return accumulate(source, [still], rescaling(scale), scaled_shape(source.info.frame_shape, scale))


def to_exposure(group: Group, trajectory: Trajectory, scale: float) -> NDArray[np.float64]:
    """Return (3, 3): pixels of the reference plane to pixels of the exposure, which is seen from the group's instant."""
    return rescaling(scale) @ inverse(trajectory.at([group.reference])[0])
