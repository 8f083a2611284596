"""The other reading of views with little perspective: near and far exchanged, and the camera turning the other way."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from photonpano import FloatArray, PoseEstimate
from photonpano_colmap.pose_spline import positions_of
from photonpano_colmap.posing.adjustment import Adjusted, Sightings, adjust
from photonpano_colmap.posing.path import posed

_POINTS = 800
"""Points by which the two readings are compared."""
_KEYPOINT_PX = 0.5
"""Error of a keypoint, px."""
_NEAREST = 0.1
"""Reversed points are at least this far away, as a share of the median depth."""
_SAME = 0.2
"""Two readings agree if turns of the camera differ by less than this share of them."""
_LEAST_SEEN = 3


def readings(first: PoseEstimate) -> tuple[Adjusted, Adjusted]:
    """Return the poses of averages as they were found, and as they are with depth reversed, each adjusted to the keypoints.

    From afar, a scene and its mirror image in depth look alike (the reversal of Necker's cube), and a reconstruction may end
    in either. Only the right one explains the perspective: it leaves the smaller residuals.
    """
    points, sightings = _chosen(first)
    poses = np.array([view.camera_from_world for view in first.views])
    return (
        adjust(poses, points, sightings, first.camera_matrix),
        adjust(*reversed_in_depth(poses, points), sightings, first.camera_matrix),
    )


def agree(first: Adjusted, second: Adjusted) -> bool:
    """Return whether the camera turns alike in two readings: adjustment may lead from the wrong one to the right one."""
    turns = [Rotation.from_matrix(each.poses[1:, :, :3] @ each.poses[0, :, :3].T) for each in (first, second)]
    return bool(np.median((turns[0] * turns[1].inv()).magnitude()) < _SAME * np.median(turns[0].magnitude()))


def reversed_in_depth(poses: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mirror (N, 3, 4) poses and (M, 3) points at the plane of the median depth; to first order, images stay as they are."""
    towards = Rotation.from_matrix(poses[:, :, :3]).mean().as_matrix()
    middle = positions_of(poses).mean(axis=0)
    seen = (points - middle) @ towards.T
    depth = float(np.median(seen[:, 2]))
    seen[:, 2] = np.maximum(2 * depth - seen[:, 2], _NEAREST * depth)
    rotations = poses[:, :, :3] @ towards.T
    centres = (positions_of(poses) - middle) @ towards.T
    target = np.array([0.0, 0.0, depth])
    # The camera pans and tilts the other way, and goes on to look at the middle of the scene.
    turned = Rotation.from_rotvec(Rotation.from_matrix(rotations).as_rotvec() * (-1, -1, 1)).as_matrix()
    looked = np.einsum("nij,nj->ni", rotations, target - centres)
    return posed(turned, target - np.einsum("nji,nj->ni", turned, looked)), seen


def _chosen(first: PoseEstimate) -> tuple[FloatArray, Sightings]:
    """Return the points that most averages show, and where these show them."""
    number = len(first.points.positions)
    views = np.concatenate([np.full(len(view.points), place) for place, view in enumerate(first.views)])
    points = np.concatenate([view.points for view in first.views])
    pixels = np.concatenate([view.xy for view in first.views])
    seen = np.bincount(points, minlength=number)
    kept = np.zeros(number, np.bool_)
    kept[np.argsort(-seen, kind="stable")[:_POINTS]] = True
    kept &= seen >= _LEAST_SEEN
    of_kept, renumbered = kept[points], np.cumsum(kept) - 1
    covariance = np.tile(_KEYPOINT_PX**2 * np.eye(2), (int(of_kept.sum()), 1, 1))
    return first.points.positions[kept], Sightings(renumbered[points[of_kept]], views[of_kept], pixels[of_kept], covariance)
