"""Other motions that are as possible as the one that was found, by which the expected error grows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from photonpano.capture import with_background
from photonpano.geometry import corners, inverse, transform_points
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.graph import Rival
from photonpano.motion.tracking import starting_motion
from photonpano.pipeline.state import State
from photonpano.residuals.causes import TestedRun, changing_places
from photonpano.residuals.findings import Doubt, Findings
from photonpano.residuals.refinement import Explained
from photonpano.residuals.verdict import MUCH, of_either_part, others_px, parallax_of
from photonpano.values import FloatArray

_MISFIT = 1.5  # reduced chi-square from which the motion does not explain a block of the sensor
_LEAST = 0.2  # least share of the frame that is not explained
_DIFFERENT_PX = 3.0  # least distance over a window and a half between two motions that are not the same
_KNOWN = 0.5  # least share of the windows of a capture in which the rival must show


def beside_alternatives(state: State, explained: Explained) -> tuple[Explained, Findings]:
    """Let the expected error of a motion contain the distance to others, where the frames do not tell which one is right.

    These are a motion that jumps where the image seems to, one that a lens does not bend, one along a second place of a scene
    that repeats, that of either part of a sensor whose parts lie apart, those by models that are as likely as the one taken,
    and that of parts of the frame which the motion does not explain. Where such a part is large and its motion is not found,
    the error is infinite: not known. What is near and rests passes the background by the way of the camera over its distance.
    """
    findings = state.found()
    run = TestedRun(explained, state.results, findings)
    n_frames, located = len(explained.motion.std_px), np.flatnonzero(explained.motion.located)
    last = state.results[-1]
    freer_px = last.located.rivals["homography"].apart_px if last.narrow else of_models_px(last.located.rivals)
    explained = _apart(explained, np.full(n_frames, np.hypot(others_px(run), freer_px)))
    if (lens := explained.lens) is not None:
        frames = np.linspace(located[0], located[-1], len(lens.bend_px))
        explained = _apart(explained, np.interp(np.arange(n_frames), frames, abs(lens.k1) * lens.bend_px))
    beside, rival = _beside_rival(state, explained)
    if rival is None and of_either_part(run):
        rotations, since = last.located.solution.rotations, np.arange(n_frames) - explained.motion.reference
        way_px = parallax_of(run) * rotations.camera.focal_px if rotations is not None else 0.0
        beside = _apart(beside, abs(since) * way_px / n_frames if way_px else np.full(n_frames, np.inf))
    return beside, replace(findings, rival_motion=rival)


def of_models_px(rivals: Mapping[str, Rival]) -> float:
    """Return the root mean square distance to the motions by other models, each as likely as its marginal likelihood says."""
    if not rivals:
        return 0.0
    deviances, apart_px = np.array([(each.deviance, each.apart_px) for each in rivals.values()]).T
    weights = np.exp(-(deviances - deviances.min()) / 2)
    return float(np.sqrt(weights @ apart_px**2 / weights.sum()))


def _apart(explained: Explained, distances_px: FloatArray) -> Explained:
    std_px = np.hypot(explained.motion.std_px, distances_px)
    return replace(explained, motion=replace(explained.motion, std_px=std_px))


def _beside_rival(state: State, explained: Explained) -> tuple[Explained, Doubt | None]:
    """Look for a second motion in short spans of frames, where the motion does not explain parts of the frame.

    Nobody can know from the frames which motion is that of the scene. If much of the panorama changes, the motion of the spans
    counts, too, where these show a single one.
    """
    share = float((np.nan_to_num(explained.residuals.block_chi2) > _MISFIT).mean())
    source = with_background(state.source, None)
    if share <= _LEAST or (start := starting_motion(source, state.results[0].groups, state.context)) is None:
        return explained, None
    known = np.isfinite(start.rivals).all(axis=1)
    shows = bool(known.mean() >= _KNOWN)
    if not shows and changing_places(explained.residuals)[0] <= MUCH:
        return explained, None
    motion = explained.motion
    apart = np.stack([start.velocities, start.rivals]) - _velocities(motion, start.instants, start.reach)
    speeds = np.nan_to_num(np.linalg.norm(apart, axis=-1))
    farther = np.take_along_axis(apart, speeds.argmax(axis=0)[None, :, None], axis=0)[0]
    differs = speeds.max(axis=0) * start.reach > _DIFFERENT_PX
    counted = known if shows else np.ones_like(known)
    velocities = np.where(differs[:, None], farther, 0.0)[counted]
    travelled = replace(start, instants=start.instants[counted], velocities=velocities).at(np.arange(len(motion.std_px)))
    away = travelled[:, :2, 2] - travelled[motion.located][:, :2, 2].mean(axis=0)
    distances_px = np.linalg.norm(away, axis=1)
    explained = _apart(explained, distances_px)
    if not shows:
        return explained, None
    mean_px = float(distances_px[motion.located].mean())
    return explained, Doubt(
        mean_px, f"px on average between both; {share:.0%} of the frame is not explained by the motion that was found"
    )


def _velocities(motion: FrameMotion, instants: FloatArray, frames: float) -> FloatArray:
    """Return the velocities of the image at N instants, over some frames: (N, 2) in px per frame."""
    first, last = (np.clip(instants + sign * frames / 2, 0, len(motion.std_px) - 1) for sign in (-1, 1))
    middle = corners(motion.frame_shape).mean(axis=0)
    moved = transform_points(inverse(motion.trajectory.at(last)) @ motion.trajectory.at(first), middle[None])[:, 0] - middle
    return np.asarray(moved / np.maximum(last - first, 1)[:, None])
