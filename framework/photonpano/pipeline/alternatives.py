"""Other motions that are as possible as the one that was found, by which the expected error grows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photonpano.capture import before
from photonpano.contracts.protocols import Trajectory
from photonpano.geometry import corners, inverse, transform_points
from photonpano.motion.timeline import UNCUT_JUMP
from photonpano.motion.tracking import starting_motion
from photonpano.pipeline.state import State
from photonpano.residuals.refinement import Explained
from photonpano.residuals.residual_tests import LEAST_K1, distorting_lens
from photonpano.residuals.tested_run import RIVAL
from photonpano.values import Decision, FloatArray

_MISFIT = 1.5  # reduced chi-square from which the motion does not explain a block of the sensor
_LEAST = 0.2  # least share of the frame that is not explained
_KNOWN = 0.5  # least share of the windows of a capture in which the rival must show


def beside_alternatives(state: State, explained: Explained) -> tuple[Explained, list[Decision]]:
    """Let the expected error of a motion contain the distance to others, where the frames do not tell which one is right.

    These are a motion that jumps where the image seems to, one that a lens does not bend, and that of parts of the frame which
    the motion does not explain.
    """
    located = np.flatnonzero(explained.motion.located)
    if (lens := distorting_lens(explained)) is not None and abs(lens.k1) > LEAST_K1:
        frames = np.linspace(located[0], located[-1], len(lens.bend_px))
        bend_px = np.interp(np.arange(len(explained.motion.std_px)), frames, abs(lens.k1) * lens.bend_px)
        explained = _apart(explained, bend_px)
    jump_px = sum(float(each.value) for each in state.decisions if each.what == UNCUT_JUMP)
    return _beside_rival(state, _apart(explained, np.full(len(explained.motion.std_px), jump_px)))


def _apart(explained: Explained, distances_px: FloatArray) -> Explained:
    std_px = np.hypot(explained.motion.std_px, distances_px)
    return replace(explained, motion=replace(explained.motion, std_px=std_px))


def _beside_rival(state: State, explained: Explained) -> tuple[Explained, list[Decision]]:
    """Look for a second motion in short spans of frames, where the motion does not explain parts of the frame.

    Nobody can know from the frames which motion is that of the scene.
    """
    share = float((np.nan_to_num(explained.residuals.block_chi2) > _MISFIT).mean())
    start = starting_motion(before(state.source, None), state.results[0].groups, state.context) if share > _LEAST else None
    if start is None:
        return explained, []
    motion, shape = explained.motion, explained.motion.frame_shape
    ours = _velocities(motion.trajectory, start.instants, start.reach, shape)
    apart = np.stack([start.velocities, start.rivals]) - ours
    other = np.take_along_axis(apart, np.nanargmax(np.linalg.norm(apart, axis=-1), axis=0)[None, :, None], axis=0)[0]
    known = np.isfinite(start.rivals).all(axis=1)
    if known.mean() < _KNOWN:
        return explained, []
    travelled = replace(start, instants=start.instants[known], velocities=other[known]).at(np.arange(len(motion.std_px)))
    away = travelled[:, :2, 2] - travelled[motion.located][:, :2, 2].mean(axis=0)
    distances_px = np.linalg.norm(away, axis=1)
    mean_px = float(distances_px[motion.located].mean())
    reason = f"px on average between both; {share:.0%} of the frame is not explained by the motion that was found"
    return _apart(explained, distances_px), [Decision(RIVAL, mean_px, reason)]


def _velocities(trajectory: Trajectory, instants: FloatArray, frames: float, frame_shape: tuple[int, int]) -> FloatArray:
    """Return the velocities of the image at N instants, over some frames: (N, 2) in px per frame."""
    first, last = (trajectory.at(instants + sign * frames / 2) for sign in (-1, 1))
    middle = corners(frame_shape).mean(axis=0)
    return np.asarray((transform_points(inverse(last) @ first, middle[None])[:, 0] - middle) / frames)
