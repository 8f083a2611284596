"""What the wrong lens does to the pairs of a motion graph: it changes homographies, and bends what lies beyond them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photonpano.geometry import Camera, corners, generators, patch_centres, slopes, transform_points
from photonpano.motion.adjustment import CAUCHY
from photonpano.robust import robust_std
from photonpano.values import FloatArray, Located

_FEWEST = 7  # patches that determine a homography
_DAMPING, _TINY = 1e-9, 1e-30


@dataclass(frozen=True, slots=True, eq=False)
class LensShift:
    """What undistorting pixels with the wrong lens does to pairs: it changes their homographies, and bends their patches."""

    points: FloatArray  # (P, 2) middles of the patches
    shifts: FloatArray  # (E, P, 2) where the patches of each pair lie beyond its homography, px; 0 where they are not known
    roots: FloatArray  # (E, P, 2, 2) R of their information R' R
    of_homography: FloatArray  # (E, 2 P, 8) derivatives of the patches by a small homography of each pair
    fitted: FloatArray  # (E, 8, 2 P) from shifts of the patches to the homography that explains them best
    to_corners: FloatArray  # (E, 8, 8) from that to the shifts of the corners

    @classmethod
    def of(cls, frame_shape: tuple[int, int], motions: Sequence[Located], counts: FloatArray) -> LensShift:
        """Take the patches of pairs, with the weights `counts`, (E,); without patches, those that both exposures see."""
        (height, width), points = frame_shape, patch_centres(frame_shape)
        observed = np.array([motion.homography for motion in motions])

        def slopes_at(places: FloatArray) -> FloatArray:
            there = observed @ np.concatenate([places, np.ones((len(places), 1))], axis=1).T
            return slopes(there, generators(frame_shape) @ there[:, None])

        mapped = transform_points(observed, points)
        seen = np.all((mapped >= 0) & (mapped <= [width - 1, height - 1]), axis=-1)
        # Four points at least determine a homography; a pair that hardly overlaps takes all.
        seen[seen.sum(axis=1) < _FEWEST] = True
        shifts, weights = np.zeros((*seen.shape, 2)), seen[..., None, None] * np.eye(2)
        roots = np.zeros_like(weights)
        for edge, patches in enumerate(motion.patches for motion in motions):
            if patches is not None and (patches.information[:, 0, 0] > 0).sum() >= _FEWEST:
                shifts[edge], weights[edge] = patches.shifts, patches.information
                values, vectors = np.linalg.eigh(counts[edge] * patches.information)
                roots[edge] = np.sqrt(np.maximum(values, 0))[..., None] * np.swapaxes(vectors, -1, -2)
        by_points = slopes_at(points)
        weighted = weights @ by_points.reshape(*seen.shape, 2, 8)
        weighted = np.swapaxes(weighted.reshape(by_points.shape), -1, -2)
        normal = weighted @ by_points
        normal += _DAMPING * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(8)
        found = cls(points, shifts, roots, by_points, np.linalg.solve(normal, weighted), slopes_at(corners(frame_shape)))
        noise = robust_std(found.unexplained()[roots.any(axis=(2, 3)).repeat(2)])
        return replace(found, roots=roots / max(noise, 1.0))

    def of_patches(self, relative: FloatArray, camera: Camera, assumed: Camera) -> FloatArray:
        """Return how patches are shifted by undistorting with the wrong lens: (E, 2 P) px, NaN if that folds the frame.

        `relative` (E, 3, 3) map ideal pixels of the true camera; pixels were undistorted with the one that was `assumed`.
        """
        there = transform_points(relative, self.points)
        seen = camera.distorted(transform_points(relative, camera.ideal(assumed.distorted(self.points))))
        return assumed.ideal_shift(there, seen - assumed.distorted(there)).reshape(len(relative), -1)

    def of_corners(self, shift: FloatArray) -> FloatArray:
        """Return by how much shifts of the patches, (E, 2 P), displace the corners of the homography: (E, 4, 2) px."""
        return np.asarray(self.to_corners @ (self.fitted @ shift[..., None])).reshape(-1, 4, 2)

    def unexplained(self, shift: FloatArray | None = None) -> FloatArray:
        """Return what shifts leave of those that were seen, beyond homographies: (2 E P,) of unit variance, outliers less."""
        left = self.shifts
        if shift is not None:
            bent = shift - (self.of_homography @ (self.fitted @ shift[..., None]))[..., 0]
            left = left - bent.reshape(left.shape)
        whitened = np.einsum("epij,epj->epi", self.roots, left)
        squares = (whitened**2).sum(axis=-1, keepdims=True) / CAUCHY**2
        return np.asarray(whitened * np.sqrt(np.log1p(squares) / np.maximum(squares, _TINY))).ravel()
