"""Adjust a reconstruction: resolve its depth reversal (the ambiguity of Necker's cube), and compare halves of its points.

From afar, a scene and its mirror image in depth look alike if the camera rotates the other way. A reconstruction may end in
either; perspective leaves larger residuals in the wrong one.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from photonpano import FloatArray, Reason
from photonpano.geometry import positions_of

_NEAREST = 0.1  # minimum distance of reversed points, in median depths
_FARTHEST_OFF_PX = 4.0  # points with a larger residual are removed, as COLMAP removes them
_SAME = 0.2  # two readings agree if their rotations differ by less than this fraction
_ALIKE = 0.9  # neither reading is likelier if the ratio of their residuals is above this
_CELLS = 0.06, 0.12  # sides of the squares of two chessboards, in focal lengths
_FEWEST = 3  # positions that determine a similarity


@dataclass(frozen=True, slots=True)
class Readings:
    """Residuals of two readings of the depth, and which is likelier."""

    found_px: float  # median distance of a point from where images show it, adjusted from the reading that COLMAP found
    reversed_px: float  # the same, adjusted from near and far exchanged
    is_reversed: bool = False  # whether the likelier one is not what COLMAP found
    differ: bool = True  # whether they are two readings: where perspective is strong, adjustment leads from either to one

    @property
    def ratio(self) -> float | None:
        """The smaller of both residuals over the larger; None if they are those of one reading."""
        return min(self.found_px, self.reversed_px) / max(self.found_px, self.reversed_px) if self.differ else None

    @property
    def doubt(self) -> Reason | None:
        """Why the depth may be reversed; None if one reading explains the images better than the other."""
        if (ratio := self.ratio) is None or ratio <= _ALIKE:
            return None
        return Reason(
            "the depth of the scene may be reversed: near and far exchanged explain the averages as well",
            ratio,
            _ALIKE,
            f"ratio of the residuals of both; {self}",
            "move farther, or nearer to the scene, so that perspective tells them apart",
        )

    def __str__(self) -> str:
        return (
            f"points are {self.found_px:.2f} px from where averages show them as COLMAP found them, and "
            f"{self.reversed_px:.2f} px with near and far exchanged"
        )


def likelier_reading(found: pycolmap.Reconstruction, finds_focal: bool) -> tuple[pycolmap.Reconstruction, Readings]:
    """Return a reconstruction adjusted to its images, with its depth reversed if that explains them better; and how well."""
    adjusted, other = copy.deepcopy(found), _reversed(found)
    found_px, reversed_px = adjust_model(adjusted, finds_focal), adjust_model(other, finds_focal)
    likelier = adjusted if found_px <= reversed_px else other
    readings = Readings(found_px, reversed_px, not _agree(found, likelier), not _agree(adjusted, other))
    for identifier, point in list(likelier.points3D.items()):
        if point.error > _FARTHEST_OFF_PX:
            likelier.delete_point3D(identifier)
    return likelier, readings


def reversed_in_depth(poses: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mirror (N, 3, 4) poses and (M, 3) points at the plane of the median depth; to first order, images stay as they are."""
    towards = Rotation.from_matrix(poses[:, :, :3]).mean().as_matrix()
    middle = positions_of(poses).mean(axis=0)
    seen = (points - middle) @ towards.T
    depth = float(np.median(seen[:, 2]))
    seen[:, 2] = np.maximum(2 * depth - seen[:, 2], _NEAREST * depth)
    rotations = poses[:, :, :3] @ towards.T
    target = np.array([0.0, 0.0, depth])
    # The camera pans and tilts the other way, and goes on to see the middle of the scene where it saw it.
    rotated = Rotation.from_rotvec(Rotation.from_matrix(rotations).as_rotvec() * (-1, -1, 1)).as_matrix()
    looked = np.einsum("nij,nj->ni", rotations, target - (positions_of(poses) - middle) @ towards.T)
    return np.concatenate([rotated, (looked - rotated @ target)[:, :, None]], axis=2), seen


def _reversed(found: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    other = copy.deepcopy(found)
    images = [image for image in other.images.values() if image.has_pose]
    identifiers = sorted(other.points3D)
    poses = np.array([image.cam_from_world().matrix() for image in images])
    points = np.array([other.points3D[identifier].xyz for identifier in identifiers])
    poses, points = reversed_in_depth(poses, points)
    for image, pose in zip(images, poses, strict=True):
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose))
    for identifier, point in zip(identifiers, points, strict=True):
        other.points3D[identifier].xyz = point
    return other


def adjust_model(model: pycolmap.Reconstruction, finds_focal: bool) -> float:
    """Adjust a reconstruction to its images, and return the median distance of a point from where they show it, px."""
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.refine_focal_length = finds_focal
    options.refine_principal_point = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1
    # This is what `pycolmap.bundle_adjustment` does, which prints a heading and its time whatever the level of its log.
    pycolmap.ObservationManager(model).filter_observations_with_negative_depth()
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    return float(np.median([point.error for point in model.points3D.values()] or [np.inf]))


def _agree(first: pycolmap.Reconstruction, second: pycolmap.Reconstruction) -> bool:
    """Return whether the camera rotates alike in two reconstructions from the same images."""
    poses = [
        np.array([each.cam_from_world().matrix() for each in model.images.values() if each.has_pose])
        for model in (first, second)
    ]
    rotations = [Rotation.from_matrix(each[1:, :, :3] @ each[0, :, :3].T) for each in poses]
    return bool(np.median((rotations[0] * rotations[1].inv()).magnitude()) < _SAME * np.median(rotations[0].magnitude()))


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
