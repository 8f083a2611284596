"""Pose estimator `stratified-pose`: the loop of the paper with six degrees of freedom (section 6, the first open direction).

A level re-samples, merges, locates and interpolates.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, FrameSpan, Group, LocationError, Progress, Reason, Source, StageContext
from photonpano.geometry import Camera, camera_matrix, corners, positions_of
from photonpano_colmap.averages import AveragesEstimator, flux_of_points, relative_std, tilt, with_focal_judged
from photonpano_colmap.exposures import (
    Path,
    PosedExposure,
    PoseSpline,
    Tremor,
    exceeding_noise_of_poses,
    find_tremor,
    inverse_depth_of,
    merge_through_depth,
    moves,
)
from photonpano_colmap.hooks import StratifiedPoseConfig
from photonpano_colmap.locating import Adjusted, Found, Observations, adjust, find_patches, patches_of, stabilised
from photonpano_colmap.reconstruction import CONTRADICTED, FOCAL_BIAS, FreeFocal
from photonpano_poses import CameraGuess, LostFrames, PosedView, PoseEstimate, ScenePoints, between, see_depth, with_depth

# A lens is contradicted by an error of k1 above this many standard errors that moves a corner of the frame as far.
_CONTRADICTION, _CONTRADICTION_PX = 5.0, 0.5
# A free focal length errs by this many of the standard errors that residuals show: of seven right ones, by 0.1 to 3.4.
_UNSEEN = 2.0
_MISSED = 0.5  # expected next pose update, as a fraction of the last one
_LOST = "too few patches of other exposures were found in theirs"


class StratifiedEstimator:
    """Begins with the poses of averages, and merges and locates the same groups again and again along what is known by then."""

    def __init__(self, config: StratifiedPoseConfig, context: StageContext) -> None:
        self._config = config
        self._context = context

    def estimate(self, source: Source, guess: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses of a capture: see `photonpano_poses.PoseEstimator`."""
        first = AveragesEstimator(self._config, self._context).averaged(source, guess, progress)
        camera = Camera(first.camera_matrix, first.distortion)
        instants = np.array([view.instant for view in first.views])
        spline = PoseSpline(instants, np.array([view.camera_from_world for view in first.views]))
        path = Path(spline.at(_frames(source)))
        scene, levels, lost = Scene(path, first.located, first.points.positions), list(first.levels), list(first.lost)
        with ThreadPoolExecutor(self._context.threads) as pool:
            for number in range(2, self._config.levels + 1 + self._config.depth):
                before = scene.path.poses
                with progress.stage(f"level {number}: merge, locate, adjust", 1, "level") as advance:
                    level = _refine(
                        source, scene, len(first.views[0].span), camera=camera, finds_focal=guess.focal_px is None, pool=pool
                    )
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
                if self._config.depth and number == self._config.levels:
                    so_far = _Assembly(source, camera, first, level, level.adjusted, before).estimate()
                    scene = replace(scene, dense=with_depth(source, so_far, self._context.threads, progress))
        first = replace(first, levels=tuple(levels), lost=tuple(sorted(lost, key=lambda each: each.span.start)))
        found = level.adjusted
        if guess.focal_px is not None and not is_far_off(first):  # from there, the exposures lead nowhere
            found = adjust(found.poses, found.points, level.observations, camera, finds_focal=True)
        estimate = with_focal_judged(_Assembly(source, camera, first, level, found, before).estimate(), self._context)
        return with_depth(source, estimate, self._context.threads, progress) if self._config.depth else estimate


@dataclass(frozen=True, slots=True, eq=False)
class _Assembly:
    """Makes the estimate of all frames from the exposures of the last level."""

    source: Source
    camera: Camera
    first: PoseEstimate  # of the averages; with the records of all levels, and the frames that any of them lost
    level: _PosedLevel
    free: Adjusted  # the exposures of the level with a focal length that is not given, unless the averages contradict that
    before: FloatArray  # (T, 3, 4), poses of all frames by the level before

    def estimate(self) -> PoseEstimate:
        level, frames, std_focal = self.level, _frames(self.source), self.level.adjusted.std_focal_px
        poses = level.path.poses.copy()
        instants = np.array([group.reference for group in level.groups])[level.is_located]
        stds = [np.interp(frames, instants, std) for std in (level.adjusted.std_position, level.adjusted.std_rotation)]
        stds[1] = np.hypot(stds[1], tilt(level.adjusted.poses, level.adjusted.std_position))
        of_focal = self._free_focal.missed(self._free_focal.images, level.adjusted.poses, self.camera.focal_px)
        stds = [np.hypot(std, np.interp(frames, instants, each)) for std, each in zip(stds, of_focal, strict=True)]
        if is_far_off(self.first):
            stds = [
                np.fmax(*each)
                for each in zip(stds, (self.first.std_position, np.deg2rad(self.first.std_rotation_deg)), strict=True)
            ]
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

    @property
    def _free_focal(self) -> FreeFocal:
        free = self.free
        std_px = math.hypot(_UNSEEN * free.std_focal_px, FOCAL_BIAS * free.focal_px)
        return FreeFocal(free.focal_px, std_px, np.arange(len(free.poses)), free.poses)

    def _contradictions(self) -> list[Reason]:
        """Doubt a lens that the exposures contradict whatever its focal length is; if they do not, doubt the focal length."""
        adjusted, camera, given = self.free, self.camera, float(self.camera.distortion[0])
        corner = camera.ideal(corners(self.source.info.frame_shape)) - camera.centre_px
        farthest = float(np.nanmax(np.linalg.norm(corner, axis=1))) / camera.focal_px
        moved_px = abs(adjusted.missed_k1) * farthest**3 * camera.focal_px
        off = abs(adjusted.missed_k1) / adjusted.std_k1
        if off < _CONTRADICTION or moved_px < _CONTRADICTION_PX:
            doubt = self._free_focal.doubt_of(camera.focal_px, "exposures")
            return [] if doubt is None else [doubt]
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


_PATCHES = 300  # patches of a key exposure
# Patches are chosen in about 12 key exposures, at least in every 10th exposure.
_KEYS = 12
_EVERY = 10
# They are searched in the 12 exposures before and after, and in every 6th of the others.
_NEIGHBOURS = 12
_FURTHER = 6
_SEEN_BY = 4  # minimum number of exposures that observe a point
_LEAST_OBSERVATIONS = 20  # minimum number of observations in a located exposure
_LEAST_LOCATED = 5  # minimum number of located exposures
# Corrections of tremor in a level end after 4, below 0.02 px, or when they grow: then depth is wrong, not the path.
_MOST_TREMORS, _LEFT_PX = 4, 0.02
_OUT_OF_SIGHT = 0.8  # exposures are compared if their centres are closer than this, in sides of a frame


def is_far_off(averages: PoseEstimate) -> bool:
    """Return whether averages contradict the focal length that is given, whose error is in theirs."""
    return any(doubt.what == CONTRADICTED.format("averages") for doubt in averages.doubts)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Path and scene before a level."""

    path: Path
    located: BoolArray  # (T,) frames whose pose is known
    points: FloatArray  # (N, 3) of the world
    dense: PoseEstimate | None = None  # with the depth of some exposures; None if it is not known


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The exposures of a level."""

    exposures: Sequence[PosedExposure]
    path: Path  # along which they are merged
    tremor: Tremor | None  # the last one found; None if the capture is too short


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _PosedLevel:
    """The exposures of a level, located."""

    groups: Sequence[Group]
    is_located: BoolArray  # (V,)
    adjusted: Adjusted  # poses of the located exposures, and points
    observations: Observations  # of these points, in the located exposures
    exposures: Sequence[PosedExposure]
    path: Path
    tremor: Tremor | None  # the last one before the exposures were located

    @property
    def left_out(self) -> list[Group]:
        """The groups that were not located."""
        return [group for group, is_located in zip(self.groups, self.is_located, strict=True) if not is_located]

    @property
    def scene(self) -> Scene:
        """Path, located frames and points for the next level."""
        located = np.zeros(len(self.path.poses), np.bool_)
        for group, is_located in zip(self.groups, self.is_located, strict=True):
            located[group.span.start : group.span.stop] = is_located
        return Scene(self.path, located, self.adjusted.points[self.adjusted.confirmed])


def _refine(
    source: Source, scene: Scene, group_size: int, *, camera: Camera, finds_focal: bool, pool: ThreadPoolExecutor
) -> _PosedLevel:
    """Locate groups (paper, section 4) that are merged and registered through the depth of the scene."""
    groups = resample(scene.located, group_size)
    merged = merge(source, groups, scene, camera, pool)
    points, observations = locate(merged.exposures, camera, pool)
    return interpolate(groups, merged, points, observations=observations, camera=camera, finds_focal=finds_focal)


def resample(located: BoolArray, group_size: int) -> tuple[Group, ...]:
    """Return groups side by side, of about this size, that cover the located frames, (T,)."""
    groups = []
    ends = np.flatnonzero(np.diff(np.concatenate([[False], located, [False]]).astype(np.int8)))
    for start, stop in ends.reshape(-1, 2).tolist():
        number = max(1, round((stop - start) / group_size))
        borders = np.linspace(start, stop, number + 1).round().astype(int).tolist()
        spans = [FrameSpan(*each) for each in pairwise(borders)]
        groups += [Group(span, span.centre) for span in spans]
    return tuple(groups)


def merge(source: Source, groups: Sequence[Group], scene: Scene, camera: Camera, pool: ThreadPoolExecutor) -> Merged:
    """Merge each group as its reference instant sees it: along the path, and along the tremor that its frames show then."""

    def depth_of(group: Group) -> NDArray[np.float32]:
        pose, shape = scene.path.at([group.reference])[0], source.info.frame_shape
        depth = inverse_depth_of(pose, scene.points, camera, shape)
        if depth is None:  # a view of no use will have no observations
            seen = scene.points @ pose[2, :3] + pose[2, 3]
            depth = np.full(shape, 1 / np.median(seen[seen > 0]) if (seen > 0).any() else 0, np.float32)
        if scene.dense is not None:
            see_depth(scene.dense, group.reference, pose, depth)
        return depth

    def along(path: Path) -> list[PosedExposure]:
        return list(pool.map(lambda *each: merge_through_depth(source, each[0], path, each[1], camera), groups, depths))

    path, depths = scene.path, list(pool.map(depth_of, groups))
    exposures, tremor = along(path), None
    for _ in range(_MOST_TREMORS):
        before, tremor = tremor, find_tremor(source, exposures, path, camera, pool)
        if tremor is None or tremor.rms_px < _LEFT_PX or (before and tremor.rms_px > before.rms_px):
            break
        path = path.rotated(tremor.rotations)
        exposures = along(path)
    return Merged(exposures, path, tremor)


def locate(exposures: Sequence[PosedExposure], camera: Camera, pool: ThreadPoolExecutor) -> tuple[FloatArray, Observations]:
    """Choose points in key exposures, (N, 3) where the depth so far has them, and find them in the others.

    Raises a `LocationError` if hardly a patch of an exposure is found in another one.
    """
    views = list(pool.map(stabilised, exposures))
    number = len(exposures)
    keys = range(0, number, max(1, min(_EVERY, number // _KEYS)))

    def sought(key: int) -> tuple[FloatArray, list[tuple[int, Found]]]:
        here = exposures[key]
        patches = patches_of(here, views[key], _PATCHES)
        found = [
            (other, find_patches(patches, (here, views[key]), (exposures[other], views[other]), camera))
            for other in range(number)
            if other != key
            and (abs(other - key) <= _NEIGHBOURS or (other - key) % _FURTHER == 0)
            and _overlap(here, exposures[other], camera)
        ]
        ideal = camera.ideal(patches.pixels)
        rays = np.concatenate([ideal, np.ones((len(ideal), 1))], axis=1) @ np.linalg.inv(camera.matrix).T
        return (rays / patches.inverse_depth[:, :1] - here.pose[:, 3]) @ here.pose[:, :3], found

    points: list[FloatArray] = []
    parts: list[tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, FloatArray]] = []
    first = 0
    for places, found in pool.map(sought, keys):
        for other, each in found:
            parts.append((each.patches + first, np.full(len(each.patches), other), each.pixels, each.covariance))
        points.append(places)
        first += len(places)
    if sum(len(part[0]) for part in parts) < _LEAST_OBSERVATIONS:
        raise LocationError(
            f"of {len(exposures)} exposures, no patch of one was found in another along the poses of the averages; they are "
            "wrong, or the exposures too dark: choose a larger pose.with.group_size"
        )
    observations = Observations(*(np.concatenate([part[k] for part in parts]) for k in range(4)))
    return _seen_often(np.concatenate(points), observations)


def interpolate(
    groups: Sequence[Group],
    merged: Merged,
    points: FloatArray,
    *,
    observations: Observations,
    camera: Camera,
    finds_focal: bool,
) -> _PosedLevel:
    """Adjust exposures and points to the observations, and correct the path by the poses of the exposures."""
    exposures = merged.exposures
    located = np.bincount(observations.views, minlength=len(exposures)) >= _LEAST_OBSERVATIONS
    if located.sum() < _LEAST_LOCATED:
        raise LocationError(
            f"of {len(exposures)} exposures, {located.sum()} show {_LEAST_OBSERVATIONS} points of others or more; choose a "
            "larger pose.with.group_size"
        )
    observations = observations.kept(located[observations.views])
    points, observations = _seen_often(points, observations)
    number = np.cumsum(located) - 1
    observations = Observations(observations.points, number[observations.views], observations.pixels, observations.covariance)
    poses = np.array([exposure.pose for exposure in exposures])[located]
    adjusted = adjust(poses, points, observations, camera, finds_focal)
    kept = [group for group, is_located in zip(groups, located, strict=True) if is_located]
    depth = np.median([np.median(each.inverse_depth) for each in exposures])
    units = camera.focal_px * np.array([1, 1, 1, depth, depth, depth])
    covariance = np.linalg.inv(adjusted.information / units[:, None] / units).astype(np.float64)
    means = exceeding_noise_of_poses(moves(poses, adjusted.poses) * units, covariance)
    # Where groups are left out between two, the border is halfway.
    inner = [(before.span.stop + after.span.start - 1) / 2 for before, after in pairwise(kept)]
    borders = np.array([kept[0].span.start - 0.5, *inner, kept[-1].span.stop - 0.5])
    path = merged.path.corrected(borders, means / units)
    return _PosedLevel(
        groups=groups,
        is_located=located,
        adjusted=adjusted,
        observations=observations,
        exposures=exposures,
        path=path,
        tremor=merged.tremor,
    )


def _overlap(here: PosedExposure, there: PosedExposure, camera: Camera) -> bool:
    """Return whether the middle of an exposure lies in another one, or not far outside."""
    turn, shift = between(here.pose, there.pose, camera.matrix)
    height, width = here.inverse_depth.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2, 1.0])
    x, y, depth = turn @ middle + shift * float(np.median(here.inverse_depth))
    away = np.abs(np.array([x / depth, y / depth]) - middle[:2]) if depth > 0 else np.inf
    return bool((away < _OUT_OF_SIGHT * np.array([width, height])).all())


def _seen_often(points: FloatArray, observations: Observations) -> tuple[FloatArray, Observations]:
    """Leave out points that few exposures see, and number the others anew."""
    seen = np.bincount(observations.points, minlength=len(points)) >= _SEEN_BY
    kept = observations.kept(seen[observations.points])
    number = np.cumsum(seen) - 1
    return points[seen], Observations(number[kept.points], kept.views, kept.pixels, kept.covariance)
