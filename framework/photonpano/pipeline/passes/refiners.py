"""Passes of refiners: each corrects the motion by what short spans of frames show beyond it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from photonpano.geometry import BLOCK_FRAMES, FrameTrajectory, corner_displacements, inverse, nearest_rotations
from photonpano.motion.attribution import attributing
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.passes.rule import Pass, tried
from photonpano.pipeline.state import State
from photonpano.protocols import Source
from photonpano.residuals.refinement import Explained, MotionFit, NamedRefiner, Refinement, require_refined
from photonpano.values import Refined

# Most corrections by one refiner. A tremor blurs the panorama that it is seen against, so that one is not enough.
MAX_ROUNDS = 6


def refine(state: State, refiners: Sequence[NamedRefiner]) -> Explained:
    """Correct the motion by refiners, each until it finds nothing, and measure what is left.

    Raises:
        CanvasTooLargeError: the panorama is far larger than what fits into the memory.
        LocationError: frames reach the horizon of the reference plane.
        PluginError: a refiner failed, or broke its contract.
    """
    refinements = []
    for place, refiner in enumerate(refiners):
        before, rounds, kept_out = state.motion, list[str](), ""
        while len(rounds) < MAX_ROUNDS:
            trial = tried(state, Correction(refiner, place, len(rounds) + 1))
            if not trial.accepted:
                kept_out = " ".join(trial.worse.split())
                break
            state = trial.state
            rounds.append(trial.found.summary)
            state.context.progress.note(f"{refiner.name}: {trial.found.summary}")
        refinements.append(Refinement(refiner.name, tuple(rounds), _change_px(before, state.motion), kept_out))
    return state.fit.explained(refinements)


class Correction(Pass[Refined]):
    """One round of a refiner."""

    def __init__(self, refiner: NamedRefiner, place: int, number: int) -> None:
        """Take the refiner, its place among those of the run, and the number of the round, from 1."""
        self._refiner, self._place, self._number = refiner, place, number

    def find(self, state: State) -> Refined | None:
        """Call the refiner.

        Raises:
            PluginError: the refiner failed, or broke its contract.
        """
        source, context = state.view.source, state.view.context
        given = self._place, self._number, state.motion.homographies, state.motion.std_px
        return context.checkpoints.once("refined", partial(_refined, self._refiner, source, state.fit, self._number), *given)

    def propose(self, state: State, found: Refined) -> State:
        """Take the corrected motion."""
        trajectory = FrameTrajectory(found.homographies)
        motion = replace(state.motion, trajectory=trajectory, homographies=found.homographies, std_px=found.std_px)
        return replace(state, refined=motion)

    def rejection(self, found: Refined, worse: str) -> str:
        """Name the refiner."""
        return f"the correction of {self._refiner.origin} ({found.summary}) is not used: {worse}"


def _refined(refiner: NamedRefiner, source: Source, fit: MotionFit, number: int) -> Refined | None:
    """Call a refiner, check what it returns, and make the homography of the reference frame the identity."""
    motion = fit.motion
    with attributing(refiner.origin, f"round {number}"):
        std_px = motion.std_px.copy()
        found = refiner.component.refine(source, motion.trajectory, std_px, fit.residuals.steps(), fit.predictions)
        if found is None:
            return None
        require_refined(found, motion.std_px)
        homographies = inverse(found.homographies[motion.reference]) @ found.homographies
        if motion.camera is not None:
            turned = nearest_rotations(motion.camera.rotations(homographies))
            return replace(found, homographies=motion.camera.homographies(turned[motion.reference].T @ turned))
        homographies /= homographies[:, 2:, 2:].copy()
        return replace(found, homographies=homographies)


def _change_px(before: FrameMotion, after: FrameMotion) -> float:
    """Return the mean displacement of the corners of the located frames."""
    total = 0.0
    for block in before.span.blocks(BLOCK_FRAMES):
        first, last = (motion.homographies[block.start : block.stop] for motion in (before, after))
        total += float(corner_displacements(inverse(first) @ last, np.eye(3), before.frame_shape).mean(axis=-1).sum())
    return total / len(before.span)
