"""Change of the homographies of pairs caused by undistorting pixels with the wrong lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from photonpano.geometry import Camera, corners, generators, slopes, transform_points
from photonpano.values import BoolArray, FloatArray

_GRID = 7  # points of a frame along each axis to which a homography is fitted


@dataclass(frozen=True, slots=True, eq=False)
class LensShift:
    """Change of the homographies of pairs caused by undistorting pixels with the wrong lens.

    Attributes:
        frame_shape: (height, width) of a frame.
        points: (P, 2) all over a frame.
        seen: (E, P) which of them both exposures of each pair see.
    """

    frame_shape: tuple[int, int]
    points: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, frame_shape: tuple[int, int], observed: FloatArray) -> LensShift:
        """Lay points over the frames of pairs with (E, 3, 3) homographies."""
        height, width = frame_shape
        x, y = ((np.arange(_GRID) + 0.5) / _GRID * side - 0.5 for side in (width, height))
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        mapped = transform_points(observed, points)
        seen = np.all((mapped >= 0) & (mapped <= [width - 1, height - 1]), axis=-1)
        # Four points at least determine a homography; a pair that hardly overlaps takes all.
        seen[seen.sum(axis=1) < _GRID] = True
        return cls(frame_shape, points, seen)

    def of_corners(self, relative: FloatArray, camera: Camera, assumed: Camera) -> FloatArray:
        """Return the change of corner displacement caused by undistorting with the wrong lens: (E, 4, 2) px.

        Args:
            relative: (E, 3, 3) homographies of the ideal pixels of the camera.
            camera: the true one.
            assumed: camera used to undistort the pixels.
        """
        ideal = camera.ideal(assumed.distorted(self.points))
        there = assumed.ideal(camera.distorted(transform_points(relative, ideal)))
        shift = there - transform_points(relative, self.points)
        weights = (self.seen & np.isfinite(shift).all(axis=-1)).astype(float)
        by_points = self._slopes(relative, self.points)
        weighted = by_points * np.repeat(weights, 2, axis=1)[..., None]
        right = np.einsum("epk,ep->ek", weighted, np.nan_to_num(shift).reshape(len(relative), -1))
        change = np.linalg.solve(np.swapaxes(weighted, -1, -2) @ by_points, right[..., None])
        moved = self._slopes(relative, corners(self.frame_shape)) @ change
        return np.asarray(moved.reshape(len(relative), 4, 2))

    def _slopes(self, relative: FloatArray, points: FloatArray) -> FloatArray:
        """Return the derivatives of mapped points by the eight parameters of a small homography that follows: (E, 2 P, 8)."""
        mapped = relative @ np.concatenate([points, np.ones((len(points), 1))], axis=1).T
        return slopes(mapped, generators(self.frame_shape) @ mapped[:, None])
