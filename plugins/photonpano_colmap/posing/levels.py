"""One level of stratified poses: re-sample, merge, locate, interpolate."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FloatArray, FrameSpan, Group, LocationError, Source
from photonpano.geometry import Camera
from photonpano_colmap.posing.adjustment import Adjusted, Observations, adjust
from photonpano_colmap.posing.merging import PosedExposure, inverse_depth_of, merge_through_depth
from photonpano_colmap.posing.patches import Found, find_patches, patches_of, stabilised
from photonpano_colmap.posing.path import Path, between, exceeding_noise_of_poses, moves
from photonpano_colmap.posing.tremor import Tremor, find_tremor

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


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Path and scene before a level."""

    path: Path
    located: BoolArray  # (T,) frames whose pose is known
    points: FloatArray  # (N, 3) of the world


@dataclass(frozen=True, slots=True, eq=False)
class Merged:
    """The exposures of a level."""

    exposures: Sequence[PosedExposure]
    path: Path  # along which they are merged
    tremor: Tremor | None  # the last one found; None if the capture is too short


@dataclass(frozen=True, slots=True, eq=False)
class PosedLevel:
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


def refine(
    source: Source, scene: Scene, group_size: int, camera: Camera, finds_focal: bool, pool: ThreadPoolExecutor
) -> PosedLevel:
    """Locate groups (paper, section 4) that are merged and registered through the depth of the scene."""
    groups = resample(scene.located, group_size)
    merged = merge(source, groups, scene, camera, pool)
    points, observations = locate(merged.exposures, camera, pool)
    return interpolate(groups, merged, points, observations, camera, finds_focal)


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
    observations: Observations,
    camera: Camera,
    finds_focal: bool,
) -> PosedLevel:
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
    return PosedLevel(groups, located, adjusted, observations, exposures, path, merged.tremor)


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
