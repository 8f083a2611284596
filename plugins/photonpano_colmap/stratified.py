"""Pose estimator `stratified-pose`: the loop of the paper with six degrees of freedom (section 6, the first open direction)."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from photonpano import (
    CameraGuess,
    FloatArray,
    LostFrames,
    PosedView,
    PoseEstimate,
    Progress,
    Reason,
    ScenePoints,
    Source,
    StageContext,
)
from photonpano.geometry import Camera, camera_matrix, corners, positions_of
from photonpano_colmap.averages import FOCAL_BIAS, AveragesEstimator, flux_of_points, relative_std, tilt, with_focal_judged
from photonpano_colmap.configs import StratifiedPoseConfig
from photonpano_colmap.posing.levels import PosedLevel, Scene, refine
from photonpano_colmap.posing.path import Path, PoseSpline

# A lens is contradicted by an error of k1 above this many standard errors that moves a corner of the frame as far.
_CONTRADICTION, _CONTRADICTION_PX = 10.0, 0.5
_MISSED = 0.5  # expected next pose update, as a fraction of the last one
_LOST = "too few patches of other exposures were found in theirs"


class StratifiedEstimator:
    """Begins with the poses of averages, and merges and locates the same groups again and again along what is known by then."""

    def __init__(self, config: StratifiedPoseConfig, context: StageContext) -> None:
        self._config = config
        self._context = context

    def estimate(self, source: Source, guess: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses of a capture: see `photonpano.PoseEstimator`."""
        first = AveragesEstimator(self._config, self._context).averaged(source, guess, progress)
        camera = Camera(first.camera_matrix, first.distortion)
        instants = np.array([view.instant for view in first.views])
        spline = PoseSpline(instants, np.array([view.camera_from_world for view in first.views]))
        path = Path(spline.at(_frames(source)))
        scene, levels, lost = Scene(path, first.located, first.points.positions), list(first.levels), list(first.lost)
        with ThreadPoolExecutor(self._context.threads) as pool:
            for number in range(2, self._config.levels + 1):
                before = scene.path.poses
                with progress.stage(f"level {number}: merge, locate, adjust", 1, "level") as advance:
                    level = refine(source, scene, len(first.views[0].span), camera, guess.focal_px is None, pool)
                    advance(1)
                camera = Camera(camera_matrix(level.adjusted.focal_px, camera.centre_px), camera.distortion)
                scene = level.scene
                # A level merges the frames that the one before located, so each level has its own to name.
                lost += [LostFrames(group.span, _LOST) for group in level.left_out]
                levels.append(
                    {
                        "group_frames": len(level.groups[0].span),
                        "averages": len(level.groups),
                        "located": int(level.is_located.sum()),
                        "points": len(scene.points),
                        "residual_px": level.adjusted.residual_px,
                        "std_position": relative_std(level.adjusted.std_position, level.adjusted.poses),
                    }
                )
        first = replace(first, levels=tuple(levels), lost=tuple(sorted(lost, key=lambda each: each.span.start)))
        return with_focal_judged(_Assembly(source, camera, first, level, before).estimate(), self._context)


@dataclass(frozen=True, slots=True, eq=False)
class _Assembly:
    """Makes the estimate of all frames from the exposures of the last level."""

    source: Source
    camera: Camera
    first: PoseEstimate  # of the averages; with the records of all levels, and the frames that any of them lost
    level: PosedLevel
    before: FloatArray  # (T, 3, 4), poses of all frames by the level before

    def estimate(self) -> PoseEstimate:
        level, frames, std_focal = self.level, _frames(self.source), self.level.adjusted.std_focal_px
        poses = level.path.poses.copy()
        instants = np.array([group.reference for group in level.groups])[level.is_located]
        stds = [np.interp(frames, instants, std) for std in (level.adjusted.std_position, level.adjusted.std_rotation)]
        stds[1] = np.hypot(stds[1], tilt(level.adjusted.poses, level.adjusted.std_position))
        if level.tremor is not None:
            stds = [np.hypot(stds[0], level.tremor.shift), np.hypot(stds[1], level.tremor.std)]
        moved = _left(positions_of(poses) - positions_of(self.before), frames, instants)
        rotated = _left(_rotations_between(self.before, poses), frames, instants)
        located = level.scene.located
        poses[~located] = np.nan
        std_position, std_rotation = (
            np.where(located, np.hypot(std, _MISSED * missed), np.nan)
            for std, missed in zip(stds, (moved, rotated), strict=True)
        )
        views = self._views()
        return replace(
            self.first,
            camera_matrix=self.camera.matrix,
            std_focal_px=math.hypot(std_focal, FOCAL_BIAS * self.camera.focal_px) if std_focal else 0.0,
            camera_from_world=poses,
            located=located,
            std_position=std_position,
            std_rotation_deg=np.rad2deg(std_rotation),
            points=ScenePoints(level.adjusted.points, flux_of_points(views, len(level.adjusted.points))),
            views=views,
            doubts=(*self.first.doubts, *self._contradictions()),
            residual_ratio=level.adjusted.excess,
        )

    def _contradictions(self) -> list[Reason]:
        """Doubt a lens that the exposures contradict."""
        adjusted, camera, given = self.level.adjusted, self.camera, float(self.camera.distortion[0])
        corner = camera.ideal(corners(self.source.info.frame_shape)) - camera.centre_px
        farthest = float(np.nanmax(np.linalg.norm(corner, axis=1))) / camera.focal_px
        moved_px = abs(adjusted.missed_k1) * farthest**3 * camera.focal_px
        off = abs(adjusted.missed_k1) / adjusted.std_k1
        if off < _CONTRADICTION or moved_px < _CONTRADICTION_PX:
            return []
        where = (
            f"a k1 of about {given + adjusted.missed_k1:.2f} fits, {given:.4g} is given, which moves the corners of a frame by "
            f"{moved_px:.2g} px; in expected errors"
        )
        todo = "calibrate the camera, and give camera.focal_px and camera.distortion"
        return [Reason("the exposures contradict the lens", off, _CONTRADICTION, where, todo)]

    def _views(self) -> tuple[PosedView, ...]:
        level, views = self.level, []
        kept = [each for each, located in zip(level.exposures, level.is_located, strict=True) if located]
        for number, (posed, pose) in enumerate(zip(kept, level.adjusted.poses, strict=True)):
            seen = level.observations.views == number
            # A point is sought from several key exposures, but is one point of one of them: it is seen once.
            points, pixels = level.observations.points[seen], self.camera.distorted(level.observations.pixels[seen])
            group = posed.exposure.group
            views.append(PosedView(group.span, group.reference, pose, points, pixels, partial(getattr, posed.exposure, "flux")))
        return tuple(views)


def _frames(source: Source) -> FloatArray:
    return np.arange(source.info.n_frames, dtype=np.float64)


def _rotations_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return small rotations from some poses to others, as rotation vectors in radians: (T, 3)."""
    between = after[:, :, :3] @ np.swapaxes(before[:, :, :3], 1, 2)
    return np.stack([between[:, j, i] - between[:, i, j] for i, j in ((1, 2), (2, 0), (0, 1))], axis=1) / 2


def _left(changes: FloatArray, frames: FloatArray, instants: FloatArray) -> float:
    """Return the root mean square length of (T, 3) changes, beyond what is linear between some instants."""
    at = changes[np.rint(instants).astype(int)]
    linear = np.stack([np.interp(frames, instants, at[:, axis]) for axis in range(3)], axis=1)
    return float(np.sqrt(np.mean(np.sum((changes - linear) ** 2, axis=1))))
