"""The canvas of a panorama: its size, and the map from the reference plane to its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from photonpano.geometry.homographies import apply, corners, rescaling, translation
from photonpano.values import FloatArray, Homography

BLOCK_FRAMES = 8192
"""The corners of this many frames are mapped at a time, which bounds the memory."""

Box: TypeAlias = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels of the reference frame: columns x0 to x1 - 1 and rows y0 to y1 - 1."""
Extent: TypeAlias = Literal["panorama", "reference"] | Box
"""What a canvas holds: every frame, the reference frame, or a box."""


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """The pixel grid of a panorama.

    Attributes:
        height: rows.
        width: columns.
        transform: (3, 3), pixels of the reference plane to pixels of the canvas.
    """

    height: int
    width: int
    transform: Homography

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width


def canvas_of(homographies: FloatArray, frame_shape: tuple[int, int], scale: float) -> Canvas:
    """Return the smallest canvas that holds every frame.

    Args:
        homographies: (N, 3, 3), frame pixels to reference pixels.
        frame_shape: (height, width) of a frame.
        scale: pixels of the canvas per pixel of the reference frame.

    Raises:
        ValueError: a frame reaches the horizon of the reference plane, so that no finite canvas holds it.
    """
    frame = corners(frame_shape)
    depth = (homographies[:, 2:, :2] @ frame.T + homographies[:, 2:, 2:]).min(axis=(1, 2))
    if depth.min() <= 0:
        index = int(np.argmin(depth))
        raise ValueError(f"homography {index} of {len(homographies)} sends part of its frame behind the reference plane")
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for start in range(0, len(homographies), BLOCK_FRAMES):
        points = apply(homographies[start : start + BLOCK_FRAMES], frame).reshape(-1, 2)
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    # Whole reference pixels, so that the canvas of scale 1 samples the reference frame without interpolation.
    low, high = np.floor(low + 1e-6), np.ceil(high - 1e-6)
    width, height = np.ceil((high - low + 1) * scale - 1e-6).astype(int)
    return Canvas(int(height), int(width), rescaling(scale) @ translation(-low[0], -low[1]))


def canvas_of_box(box: Box, scale: float) -> Canvas:
    """Return the canvas of a box of the reference plane.

    Args:
        box: in pixels of the reference frame.
        scale: pixels of the canvas per pixel of the reference frame.
    """
    x0, y0, x1, y1 = box
    width, height = (int(np.ceil(side * scale - 1e-6)) for side in (x1 - x0, y1 - y0))
    return Canvas(height, width, rescaling(scale) @ translation(-x0, -y0))
