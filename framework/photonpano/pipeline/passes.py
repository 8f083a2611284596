"""The passes after the first level of the loop, and the refiners after the last one.

A pass is accepted if the residuals of the photons do not grow.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np

from photonpano.capture import capture_of, in_light, leaving_out, with_background
from photonpano.contracts.attribution import label_of
from photonpano.contracts.protocols import Source, Trajectory, camera_of, camera_of_motion, light_of
from photonpano.corrections import FlatField, Vignette, divided_by, estimate_vignette
from photonpano.corrections.lighting import corrected_light, decision_of, find_light, measure_light, measure_pixel_gain
from photonpano.corrections.movers import find_background, without_layers
from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.geometry import (
    BLOCK_FRAMES,
    Camera,
    FrameTrajectory,
    corner_displacements,
    inverse,
    lenses_apart_px,
    likely_rotations,
)
from photonpano.motion.diagnosis import UntiedError
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Cut, Recorder
from photonpano.motion.loop import TOO_NARROW, converges
from photonpano.motion.models import SAME_LENS_PX
from photonpano.motion.trajectories import REMAINING_SHARE
from photonpano.pipeline.components import build_levels, built, stage_context
from photonpano.pipeline.obstacles import ApartError, shots_of
from photonpano.pipeline.state import State, within
from photonpano.plugins.contributions import MergerContribution
from photonpano.residuals.causes import changing_places
from photonpano.residuals.cuts import SMALLEST_PX, find_cuts
from photonpano.residuals.findings import Doubt
from photonpano.residuals.refinement import Explained, MotionFit, NamedRefiner, Refinement
from photonpano.specs.plan import Plan
from photonpano.values import Background, FloatArray, Journal, Light, Refined

logger = logging.getLogger(__name__)

_FAILED = 0.05  # share of the pairs that are not located beyond which the motion is not trusted to tell what moves by itself
_SHOWING = 0.5  # share of the exposures that must show something when what hides the background is left out
_CHANGING = 0.003  # share of the panorama that changes over time beyond which what moves is looked for again
_EXPLAINED = 0.9  # changing light is accepted if it lowers the reduced chi-square of the photons to this fraction
MAX_ROUNDS = 6  # maximum number of corrections by one refiner: a tremor blurs the panorama that residuals are taken against
# A later correction that moves frames by less than this on average needs no new panorama: residuals change in proportion to it.
_LINEAR_PX = 0.1
_NOT_RELOCATED = "the motion of the last level along the refined one is not used"
_BLURRED_PX = 1.0  # mean correction by which the exposures were blurred so that it pays to locate them again


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Proposal:
    """A change of the state."""

    make: Callable[[], State | None]  # returns the new state; None if a closer look finds nothing to change
    # returns how the new motion explains the photons worse than the old one, as a clause, empty if it does not; None to accept
    # the new state without comparison, so that its errors end the run
    worse: Callable[[MotionFit, MotionFit], str] | None = MotionFit.worse_than
    settle: Callable[[State], State] = lambda proposed: proposed  # completes the new state once it is accepted
    rejection: str = ""  # begins the message about a proposal that is rejected
    severity: int = logging.DEBUG  # of this message
    summary: str = ""
    refused: Callable[[State], State] = lambda state: state  # completes the state that is kept when the proposal is rejected


Pass: TypeAlias = Callable[[State], Proposal | None]


class Trial(NamedTuple):
    """The state after a pass; whether its proposal was accepted, with a summary of it; and otherwise why not.

    It does not hold the proposal, and with it the state before: both have a panorama.
    """

    state: State
    accepted: bool = False
    summary: str = ""
    worse: str = ""


def tried(state: State, propose: Pass) -> Trial:
    """Try a pass. The state before is kept if the new motion cannot be estimated, or explains the photons worse."""
    if (proposal := propose(state)) is None:
        return Trial(state)
    if (name := getattr(propose, "__name__", "")).isidentifier():
        state.context.progress.note(f"a pass is tried: {name.replace('_', ' ')}")
    try:
        if (proposed := proposal.make()) is None:
            return Trial(state)
        worse = "" if proposal.worse is None else proposal.worse(proposed.fit(), state.fit())
    except (LocationError, CanvasTooLargeError) as error:
        if proposal.worse is None:
            raise
        worse = str(error)
    else:
        if not worse:
            return Trial(proposal.settle(proposed), accepted=True, summary=proposal.summary)
    logger.log(proposal.severity, "%s: %s", proposal.rejection, worse)
    return Trial(proposal.refused(state), worse=worse)


def through_found_lens(state: State) -> Proposal | None:
    """Run the last level again with the lens that it found, if that differs from the one through which it saw the frames.

    Homographies between frames with a lens are not exact: pairs are off by pixels. Lenses that differ by less than the expected
    error of the motion move it by no more than that.
    """
    found, result = camera_of_motion(state.trajectory), state.results[-1]
    if found is None:
        return None
    seen = camera_of(result.exposures.source) or Camera(found.matrix)
    if lenses_apart_px(found, seen, state.source.info.frame_shape) < max(SAME_LENS_PX, result.uncertainty.mean_px):
        return None
    return Proposal(make=lambda: state.located([result.level], state.trajectory), worse=None)


def without_shading(state: State) -> Proposal | None:
    """Divide the capture by the flat field that its spec asks for, or by its vignette; leave out what hides the background.

    Shading hides what moves, and what moves looks like shading: the vignette is measured again on the background alone. Raises
    `InputError` if the motion does not separate a flat field from the scene.
    """
    plan, source = state.plan, state.view.source
    asked = any(isinstance(each, FlatField) for each in plan.corrections)
    found = _flat_field(state) if asked else vignette_of(plan, source, state.trajectory)
    if found is None:
        return without_movers(state)

    def divided(by: Vignette) -> State:
        return tried(state.corrected(divided_by(state.source, by), by), without_movers).state

    def make() -> State:
        first = divided(found)
        if asked or (background := capture_of(first.source).background) is None:
            return first
        again = vignette_of(plan, with_background(source, background), state.trajectory)
        return first if again is None else divided(again)

    return Proposal(make=make, worse=None)


def vignette_of(plan: Plan, source: Source, trajectory: Trajectory) -> Vignette | None:
    """Measure the vignette of a capture, unless its spec lists corrections, or a merger does not accept corrected sums."""
    mergers = [level.merge.contribution for level in plan.levels]
    accepted = all(isinstance(merger, MergerContribution) and merger.accepts_corrected_sums for merger in mergers)
    if not plan.corrects_itself or source.info.kind != "binary" or not accepted:
        return None
    return estimate_vignette(source, trajectory)


def _flat_field(state: State) -> Vignette:
    source = state.view.source
    measured = measure_pixel_gain(source, state.trajectory, state.context)
    counts = np.sum([source.counts(span) for span in measured.spans], axis=0) / sum(map(len, measured.spans))
    return Vignette(measured.gain, counts.astype(np.float32), measured.spans, measured.std)


def in_changing_light(state: State) -> Proposal | None:
    """Measure the light along the motion, and locate the first level again in it.

    The first motion was estimated as if the light were steady, so that the light is measured once more along the second one.
    `light: auto` takes the light for steady if it does not change along that, or if it explains the photons worse. `light:
    steady` warns if it changes.
    """
    mode, levels, source = state.plan.light.mode, state.levels[:1], state.source
    measure = measure_light if mode == "changing" else find_light
    light = measure(state.view.source, state.trajectory, state.context)
    if light is None:
        return None
    if mode == "steady":
        logger.warning(f"light: steady, but {decision_of(light, source.info.frame_rate_hz).reason}; write light: auto")
        return None

    def lit(light: Light) -> State:
        return state.corrected(in_light(source, light), light)

    def make() -> State | None:
        first = lit(light).located(levels, state.trajectory)
        again = measure(replace(first, source=source).view.source, first.trajectory, state.context)
        return None if again is None else lit(again).located(levels, first.trajectory)

    def settle(proposed: State) -> State:
        found, residuals = light_of(proposed.source), proposed.fit().residuals
        assert found is not None
        corrected = corrected_light(found, residuals.spans, *residuals.gains())
        return replace(lit(corrected), results=proposed.results, outdated=False)

    rejection = "the light is taken for steady, since in the light that was found"
    return Proposal(make=make, worse=None if mode == "changing" else worse_in_light, settle=settle, rejection=rejection)


def worse_in_light(proposed: MotionFit, before: MotionFit) -> str:
    """Compare the residuals of a motion in changing light with those in steady light.

    Where the light explains the brightness of the frames, the scatter of the shifts does not count: groups blur the panorama of
    level 1 by a tremor, and the steps against it are wrong by much more than their noise.
    """
    return "" if proposed.reduced_chi2 < _EXPLAINED * before.reduced_chi2 else proposed.worse_than(before)


def later_levels(state: State) -> Proposal:
    """Run the levels that are left; a single one again, if the capture was corrected since.

    In light that flickers, group sizes that are chosen from the capture are chosen anew: whole periods of the light. What hides
    the background is looked for again after each level, which knows the motion better.
    """
    levels, light = state.levels, light_of(state.source)
    if light is not None and light.frequency:
        levels = build_levels(state.plan, state.source, state.findings.started, state.shortened, state.start)
    left = levels if state.outdated and len(levels) == 1 else levels[1:]

    def make() -> State:
        located = replace(state, levels=levels)
        if located.watched and capture_of(state.source).background is None:
            return located.located(left, state.trajectory)
        for level in left:
            located = tried(located.located([level], located.trajectory), without_movers).state
            if located.plan.until_converged and level.scale == levels[-1].scale and not converges(located.results):
                break
        return located

    return Proposal(make=make, worse=None)


def without_movers(state: State) -> Proposal | None:
    """Leave out what hides the background by the motion known so far: pairs that show both follow something in between."""
    if _uncertain(state):
        return None
    last, source = state.results[-1], with_background(state.view.source, None)
    # The motion after a single level is as rough as that after the first of several.
    exact = len(state.levels) > 1 and last.level.number == state.levels[-1].number
    found = find_background(
        source, state.trajectory, camera_of_motion(state.trajectory), state.motion.span, state.context, exact=exact
    )
    located = last.located
    if (layers := located.solution.layers) is not None:
        there = located.solution.located
        found = without_layers(found, located.instants, layers[there], state.source.info.frame_shape)
    # Where most exposures would show nothing, the scene itself was taken for what hides it.
    if found is not None and np.mean([found.cells(each.span).any() for each in last.exposures.groups]) < _SHOWING:
        found = None
    watched = replace(state if found is None else _with_background(state, found), watched=True)
    # Residuals of what is left out, and not, cannot be compared.
    return Proposal(make=lambda: watched, worse=None)


def without_what_changes(state: State) -> Proposal | None:
    """Leave out what hides the background by the refined motion, too, if parts of the panorama change over time."""
    share, _ = changing_places(state.fit().residuals)
    if share < _CHANGING or _uncertain(state):
        return None
    source, known = with_background(state.view.source, None), capture_of(state.source).background
    found = find_background(source, state.motion.trajectory, state.motion.camera, state.motion.span, state.context, exact=True)
    if found is None:
        return None
    found = found if known is None else found.without(known)
    return Proposal(make=lambda: replace(_with_background(state, found), known_fit=None), worse=None)


def _with_background(state: State, found: Background) -> State:
    return replace(state, source=with_background(state.source, found), context=within(state.context, found), outdated=True)


def _uncertain(state: State) -> bool:
    """Return whether the motion may be wrong somewhere, where all of the background would differ from what is expected."""
    located = state.results[-1].located
    # What a freer motion explains does not move by itself.
    return state.results[-1].narrow > TOO_NARROW or len(located.failures) > _FAILED * len(located.edges)


def again_without_movers(state: State) -> Proposal | None:
    """Run the last level again, if what hides the background was looked for since, in the light of lamps on what is left."""
    if not state.outdated or capture_of(state.source).background is None:
        return None
    return Proposal(make=lambda: _in_lamps(state).located([state.results[-1].level], state.trajectory), worse=None)


def _in_lamps(state: State) -> State:
    """Return the state in the light that lamps, if any flicker, shed on the background that is known now."""
    light = light_of(state.source)
    if light is None or not light.frequency:
        return state
    found = measure_light(_in_steady_light(state.view.source), state.trajectory, state.context)
    if not found.has_lamps:
        return state
    return state.corrected(in_light(state.source, found), found)


def cut_at_jumps(state: State) -> Proposal | None:
    """Cut the motion where the image jumps, and locate all levels again: exposures across a jump bias the first level, too.

    Where the pieces then meet to less than 1 px, there was no jump. Raise `ApartError` where no pair ties them together.
    """
    # Where a motion is wrong, much looks as if it moved by itself: what is left of the photons may not show the jump.
    every = state if capture_of(state.source).background is None else replace(state, source=with_background(state.source, None))
    cuts = find_cuts(every.source, every.fit(), state.context)
    if not cuts:
        return None

    def make(cuts: Sequence[Cut] = cuts) -> State | None:
        levels = build_levels(state.plan, state.source, state.findings.started, state.shortened, state.start)
        try:
            cut = _located_anew(replace(state, timeline=state.timeline.cut_at(cuts), levels=levels))
        except UntiedError as error:
            if shots := shots_of(state.source, error.groups, error.parts, [each.frame for each in cuts]):
                raise ApartError(shots) from error
            raise
        measured = [each.along(cut.motion.trajectory, cut.motion.frame_shape) for each in cuts]
        jumps = [each for each in measured if each.dark is not None or each.size_px >= SMALLEST_PX]
        if len(jumps) < len(cuts):
            return make(jumps) if jumps else None
        return replace(cut, timeline=cut.timeline.cut_at(measured))

    # Dark frames raise the residuals of any motion, most where its expected error is small; their run is doubtful anyway.
    dark = any(each.dark is not None for each in cuts)
    places = ", ".join(f"frame {each.frame}" for each in cuts)
    rejection = f"the image seems to jump before {places}, but the motion is not cut there"

    def refused(state: State) -> State:
        largest = max(cuts, key=lambda each: each.size_px)
        found = Doubt(largest.size_px, f"px before frame {largest.frame}; cut there, the motion explains less")
        return replace(state, findings=replace(state.findings, uncut_jump=found))

    worse = (lambda *_: "") if dark else MotionFit.worse_than
    return Proposal(make=make, worse=worse, refused=refused, rejection=rejection, severity=logging.WARNING)


def _located_anew(state: State) -> State:
    """Locate all levels; light, and what hides the background, are found anew, since that was done along another motion."""
    if capture_of(state.source).background is None and state.light is None:
        return state.located(state.levels, state.start)
    anew = replace(state, source=with_background(_in_steady_light(state.source), None), light=None, watched=False)
    anew = anew.located(state.levels[:1], state.start)
    light = [] if state.light is None else [in_changing_light]
    again: tuple[Pass, ...] = (without_movers, *light, later_levels, again_without_movers)
    for each in again:
        anew = tried(anew, each).state
    return anew


def _in_steady_light(source: Source) -> Source:
    """Return a capture as if its light were steady; frames that were left out stay so."""
    light = light_of(source)
    return source if light is None else leaving_out(replace(capture_of(source), light=None), light.shown)


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
                state = tried(state, lambda known: Proposal(make=known.relocated, rejection=_NOT_RELOCATED)).state
        refinements.append(Refinement(refiner.name, tuple(rounds), _change_px(before, state.motion), kept_out))
    state = tried(state, without_what_changes).state
    return state, state.fit().explained(refinements)


def _corrected(state: State, refiner: NamedRefiner, place: int, number: int, decisions: Journal | None) -> Proposal | None:
    """Propose the motion that a refiner finds at a round, from 1; `place` is its own among those of the run."""
    once, known = state.view.context.checkpoints.once, state.motion
    refined = partial(_refined, refiner, state)
    found = once("refined", refined, place, number, known.homographies, known.noise_px, decisions=decisions)
    if found is None:
        return None
    remaining_px = REMAINING_SHARE * _moved_px(state.motion, found.homographies)
    std_px = np.hypot(found.std_px, remaining_px)
    trajectory, homographies = FrameTrajectory(found.homographies), found.homographies
    motion = replace(state.motion, trajectory=trajectory, homographies=homographies, std_px=std_px, remaining_px=remaining_px)
    if number > 1 and _change_px(state.motion, motion) < _LINEAR_PX:
        return Proposal(
            make=lambda: replace(state, refined=motion, known_fit=state.fit().moved(motion)), worse=None, summary=found.summary
        )
    rejection = f"a correction of {label_of(refiner.component)} is not used"
    return Proposal(make=lambda: replace(state, refined=motion, known_fit=None), rejection=rejection, summary=found.summary)


def _refined(refiner: NamedRefiner, state: State) -> Refined | None:
    """Call a refiner, and make the homography of the reference frame the identity."""
    motion, fit = state.motion, state.fit()
    source, residuals = state.view.source, fit.residuals.steps()
    found = refiner.component.refine(source, motion.trajectory, motion.noise_px, residuals, fit.predictions)
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
