"""How a lens moves the homographies of pairs."""

from __future__ import annotations

import numpy as np

from photonpano.geometry import Camera, corners, rotation_matrices, transform_points
from photonpano.motion.rotation_graph import LensShift

SHAPE = (254, 496)
LENS = (-0.1, 0.0, 0.0, 0.0)
RELATIVE = rotation_matrices([[0.02, 0.15, 0.05], [0.0, -0.3, 0.0]])


def test_known_lens_leaves_homographies_as_they_are() -> None:
    camera = Camera.of(330.0, SHAPE, LENS)
    relative = camera.homographies(RELATIVE)
    np.testing.assert_allclose(LensShift.of(SHAPE, relative).of_corners(relative, camera, camera), 0, atol=1e-8)


def test_unknown_lens_moves_corners_as_the_best_homography_between_distorted_pixels() -> None:
    """Between pixels that are taken for ideal, the homography with the least squares over common points is fitted."""
    camera, seen_by = Camera.of(330.0, SHAPE, LENS), Camera.of(330.0, SHAPE)
    relative = camera.homographies(RELATIVE)
    lens = LensShift.of(SHAPE, relative)
    found = transform_points(relative, corners(SHAPE)) + lens.of_corners(relative, camera, seen_by)
    for number, homography in enumerate(relative):
        points = lens.points[lens.seen[number]]
        there = camera.distorted(transform_points(homography, camera.ideal(points)))
        x, y, (u, v), one, zero = *points.T, there.T, np.ones(len(points)), np.zeros(len(points))
        rows = [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], 1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], 1),
        ]
        best = np.append(np.linalg.lstsq(np.concatenate(rows), np.concatenate([u, v]), rcond=None)[0], 1).reshape(3, 3)
        moved = np.abs(transform_points(best, corners(SHAPE)) - transform_points(homography, corners(SHAPE))).max()
        assert moved > 5
        # Least squares of the equations weigh points otherwise than least squares of distances.
        assert np.abs(found[number] - transform_points(best, corners(SHAPE))).max() < 0.2 * moved
