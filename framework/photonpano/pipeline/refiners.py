"""Refine the motion: refiners correct it by the residual shifts of short spans of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from photonpano.contracts.attribution import label_of
from photonpano.contracts.protocols import Source
from photonpano.geometry import BLOCK_FRAMES, FrameTrajectory, corner_displacements, inverse, likely_rotations
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Recorder
from photonpano.motion.uncertainty import REMAINING_SHARE
from photonpano.pipeline.components import built, stage_context
from photonpano.pipeline.passes import Proposal, tried, without_what_changes
from photonpano.pipeline.state import State
from photonpano.residuals.refinement import Explained, NamedRefiner, Refinement
from photonpano.specs.plan import Plan
from photonpano.values import FloatArray, Journal, Refined

MAX_ROUNDS = 6  # maximum number of corrections by one refiner: a tremor blurs the panorama that residuals are taken against
# A later correction that moves frames by less than this on average needs no new panorama: residuals change in proportion to it.
_LINEAR_PX = 0.1
_NOT_RELOCATED = "the motion of the last level along the refined one is not used"
_BLURRED_PX = 1.0  # mean correction by which the exposures were blurred so that it pays to locate them again


def build_refiners(plan: Plan, source: Source, decisions: Journal) -> tuple[NamedRefiner, ...]:
    """Build the refiners of a plan, in order; `decisions` receives their choices."""
    context = stage_context(plan, source, Recorder(decisions))
    return tuple(NamedRefiner(choice.contribution.name, built(choice, context, "the refinement")) for choice in plan.refine)


def refine(state: State, refiners: Sequence[NamedRefiner], decisions: Journal | None = None) -> tuple[State, Explained]:
    """Correct the motion by refiners, each until it finds nothing, and measure what is left. For errors, see `run`.

    `decisions` receives those of the refiners.

    Where the first correction moves frames by more than a pixel, that motion had blurred the exposures of the last level, which
    then runs again along the corrected motion.
    """
    refinements = []
    for place, refiner in enumerate(refiners):
        before, rounds, kept_out = state.motion, list[str](), ""
        while len(rounds) < MAX_ROUNDS and not state.context.time_limit.leaves_out("refinements"):
            each = partial(_corrected, refiner=refiner, place=place, number=len(rounds) + 1, decisions=decisions)
            state, accepted, summary, worse = tried(state, each)
            if not accepted:
                kept_out = " ".join(worse.split())
                break
            rounds.append(summary)
            state.context.progress.note(f"{refiner.name}: {summary}")
            if len(rounds) == 1 and _change_px(before, state.motion) > _BLURRED_PX:
                state = tried(state, lambda known: Proposal(known.relocated, rejection=_NOT_RELOCATED)).state
        refinements.append(Refinement(refiner.name, tuple(rounds), _change_px(before, state.motion), kept_out))
    state = tried(state, without_what_changes).state
    return state, state.fit.explained(refinements)


def _corrected(state: State, refiner: NamedRefiner, place: int, number: int, decisions: Journal | None) -> Proposal | None:
    """Propose the motion that a refiner finds at a round, from 1; `place` is its own among those of the run."""
    given = place, number, state.motion.homographies, state.motion.noise_px
    found = state.view.context.checkpoints.once("refined", partial(_refined, refiner, state), *given, decisions=decisions)
    if found is None:
        return None
    remaining_px = REMAINING_SHARE * _moved_px(state.motion, found.homographies)
    std_px = np.hypot(found.std_px, remaining_px)
    trajectory, homographies = FrameTrajectory(found.homographies), found.homographies
    motion = replace(state.motion, trajectory=trajectory, homographies=homographies, std_px=std_px, remaining_px=remaining_px)
    if number > 1 and _change_px(state.motion, motion) < _LINEAR_PX:
        return Proposal(lambda: replace(state, refined=motion, known_fit=state.fit.moved(motion)), None, summary=found.summary)
    rejection = f"a correction of {label_of(refiner.component)} is not used"
    return Proposal(lambda: replace(state, refined=motion, known_fit=None), rejection=rejection, summary=found.summary)


def _refined(refiner: NamedRefiner, state: State) -> Refined | None:
    """Call a refiner, and make the homography of the reference frame the identity."""
    motion, fit = state.motion, state.fit
    given = state.view.source, motion.trajectory, motion.noise_px, fit.residuals.steps(), fit.predictions
    found = refiner.component.refine(*given)
    if found is None:
        return None
    homographies = inverse(found.homographies[motion.reference]) @ found.homographies
    if (rotations := motion.rotations) is not None and (camera := motion.camera) is not None:
        # Each correction is a small step of its frame, whose homography may be far from any of a plane.
        steps = likely_rotations(camera, inverse(motion.homographies) @ found.homographies, motion.frame_shape)
        turned = rotations @ steps
        return replace(found, homographies=camera.homographies(turned[motion.reference].T @ turned))
    homographies /= homographies[:, 2:, 2:].copy()
    return replace(found, homographies=homographies)


def _change_px(before: FrameMotion, after: FrameMotion) -> float:
    """Return the mean displacement of the corners of the located frames."""
    return float(_moved_px(before, after.homographies)[before.located].mean())


def _moved_px(before: FrameMotion, after: FloatArray) -> FloatArray:
    """Return the displacement of the corners of each frame, (T,), to other homographies, (T, 3, 3)."""
    blocks = [slice(start, start + BLOCK_FRAMES) for start in range(0, len(after), BLOCK_FRAMES)]
    steps = (inverse(before.homographies[block]) @ after[block] for block in blocks)
    return np.concatenate([corner_displacements(step, np.eye(3), before.frame_shape).mean(axis=-1) for step in steps])
