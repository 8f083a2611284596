"""Estimate the motion of a capture: all levels, and again what a vignette or a jump of the image has led astray."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from photonpano.capture import seen_through
from photonpano.captures.repeats import timeline_of
from photonpano.context import Context
from photonpano.contributions import MergerContribution
from photonpano.corrections import FlatField, Vignette, divided_by, estimate_vignette
from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.lighting import corrected_light, decision_of, find_light, in_light, measure_light, measure_pixel_gain
from photonpano.motion.frame_motion import motion_of_frames
from photonpano.motion.level import Level
from photonpano.motion.loop import LevelResult, estimate_motion, through_lens
from photonpano.motion.model import MotionModel
from photonpano.motion.timeline import Cut, Timeline
from photonpano.motion.tracking.velocity import ConstantVelocity, find_velocity
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.run_steps import require_centre
from photonpano.protocols import Source, Trajectory, camera_of_motion, light_of
from photonpano.residuals.cuts import find_cuts
from photonpano.residuals.refinement import Look
from photonpano.specs.plan import Plan
from photonpano.values import Decision, Light

logger = logging.getLogger(__name__)

START = "start"
"""The decision on a motion that is known before the first level."""
_EXPLAINED = 0.9
"""Light that lowers the misfit of the photons by this factor, or more, is there."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The motion of a capture.

    Attributes:
        source: the capture, divided by its vignette if it has one, and in its light if that changes.
        context: of what is done with this source: its checkpoints depend on vignette and light.
        results: of all levels.
        timeline: where frames repeat, and where the image jumps.
        look: the motion, the panorama along it, and what that does not explain.
        vignette: by which the source is divided.
        start: the motion that was known before the first level; None if there was none.
    """

    source: Source
    context: Context
    results: list[LevelResult]
    timeline: Timeline
    look: Look
    vignette: Vignette | None
    start: Trajectory | None = None


def estimate(plan: Plan, source: Source, decisions: list[Decision], context: Context) -> Estimate:
    """Estimate the motion of a capture, and correct what the capture shows to be in its way.

    Args:
        plan: what to do.
        source: the capture.
        decisions: what was chosen from the capture; added to.
        context: threads, progress and checkpoints.

    Raises:
        InputError: all frames are copies of the first one, or too few for the start, or the camera has other frames.
        LocationError: the motion could not be estimated.
        CanvasTooLargeError: the panorama would be far larger than the memory.
        PluginError: a component failed in its own way, or broke its contract.
    """
    require_centre(plan, source)
    reference = _reference_frame(plan, source)
    levels = build_levels(plan, source, decisions)
    timeline = timeline_of(source, context)
    start = start_of(plan, source, reference, decisions, context)
    results = estimate_motion(
        source, levels[:1], plan.graph, reference, context, previous=start, timeline=timeline, model=model_of(plan)
    )
    if model_of(plan).finds_lens and camera_of_motion(results[0].trajectory) is not None:
        # Through a lens that nobody knew, pairs are located with errors of pixels: once more, through the one that was found.
        known = results[0].trajectory
        results = estimate_motion(
            source, levels[:1], plan.graph, reference, context, previous=known, timeline=timeline, model=model_of(plan)
        )
    first, later = results, levels[1:]
    known = first[0].trajectory
    in_view = _in_view(plan, source, first, context)[0]
    if vignette := _flat_field(plan, in_view, known, context) or vignette_of(plan, in_view, known):
        decisions.append(vignette.decision)
        source, context = divided_by(source, vignette), replace(context, checkpoints=context.checkpoints.within(vignette))
        if not later:
            results, later = [], levels
    lit = _lit(plan, source, levels, first, reference, timeline, context)
    if lit is not None:
        source, context, first, decision = lit
        decisions.append(decision)
        levels = _in_whole_periods(plan, source, levels, decisions)
        known = first[0].trajectory
        results, later = first, levels[1:]
    results += estimate_motion(
        source, later, plan.graph, reference, context, plan.until_converged, known, timeline, model_of(plan)
    )
    found = Estimate(source, context, results, timeline, _look(plan, source, results, reference, context), vignette, start)
    if cuts := find_cuts(source, found.look, context):
        found = _cut_at(cuts, plan, found)
    decisions += [*found.timeline.decisions, *_model_decisions(plan, found.results)]
    source, context = _in_view(plan, found.source, found.results, found.context)
    return replace(found, source=source, context=context)


def _in_whole_periods(plan: Plan, source: Source, levels: tuple[Level, ...], decisions: list[Decision]) -> tuple[Level, ...]:
    """Return the levels with groups that suit flickering light, where their size is chosen from the capture."""
    light = light_of(source)
    if light is None or not light.frequency:
        return levels
    decisions[:] = [each for each in decisions if each.what != "group_size"]
    return build_levels(plan, source, decisions)


def _lit(
    plan: Plan,
    source: Source,
    levels: Sequence[Level],
    steady: Sequence[LevelResult],
    reference: int,
    timeline: Timeline,
    context: Context,
) -> tuple[Source, Context, list[LevelResult], Decision] | None:
    """Measure the light of a capture along a motion, and estimate the first level again in this light.

    `light: steady` measures it, too, and warns if it changes. The first motion, of the results `steady`, was estimated in light
    that seemed steady, so that the light is measured once more along the second one. `light: auto` takes the light for steady
    if it does not change along that, or if the photons are explained worse in the light that was found.

    Returns:
        The capture in its light, its context, the first level in it, and the decision; None if the light is steady.
    """
    changing, known = plan.light.mode == "changing", steady[0].trajectory
    measured = measure_light if changing else find_light
    if (light := measured(_in_view(plan, source, steady, context)[0], known, context)) is None:
        return None
    if plan.light.mode == "steady":
        logger.warning(f"light: steady, but {decision_of(light, source.info.frame_rate_hz).reason}; write light: auto")
        return None

    def lit(light: Light) -> tuple[Source, Context]:
        return in_light(source, light), replace(context, checkpoints=context.checkpoints.within(light))

    def first_level(light: Light, known: Trajectory) -> list[LevelResult]:
        in_this, within = lit(light)
        return estimate_motion(
            in_this, levels[:1], plan.graph, reference, within, previous=known, timeline=timeline, model=model_of(plan)
        )

    worse = ""
    try:
        first = first_level(light, known)
        known = first[0].trajectory
        if (again := measured(_in_view(plan, source, first, context)[0], known, context)) is None:
            return None
        results = first_level(again, known)
        in_this, within = lit(again)
        look = _look(plan, in_this, results, reference, within)
        light = corrected_light(again, look.residuals.spans, *look.residuals.gains())
        if not changing:
            worse = _worse_in_light(look, _look(plan, source, steady, reference, context))
    except (LocationError, CanvasTooLargeError) as error:
        if changing:
            raise
        worse = str(error)
    if worse:
        logger.debug("the light is taken for steady: in the light that was found, %s", worse)
        return None
    return *lit(light), results, decision_of(light, source.info.frame_rate_hz)


def _worse_in_light(look: Look, before: Look) -> str:
    """Return how the photons are explained worse than in steady light, as a clause; empty if they are not.

    Where the light explains the brightness, the scatter of the shifts does not count: groups blur the panorama of level 1 by a
    tremor, and the steps against it are then wrong by much more than their noise.
    """
    if float(look.residuals.misfit.mean()) < _EXPLAINED * float(before.residuals.misfit.mean()):
        return ""
    return look.worse_than(before)


def vignette_of(plan: Plan, source: Source, trajectory: Trajectory) -> Vignette | None:
    """Measure the vignette of a capture, unless its spec lists corrections, or a merger does not accept corrected sums."""
    mergers = [level.merge.contribution for level in plan.levels]
    accepted = all(isinstance(merger, MergerContribution) and merger.accepts_corrected_sums for merger in mergers)
    if not plan.corrects_itself or source.info.kind != "binary" or not accepted:
        return None
    return estimate_vignette(source, trajectory)


def _flat_field(plan: Plan, source: Source, trajectory: Trajectory, context: Context) -> Vignette | None:
    """Measure the flat field of a capture; None if its spec does not ask for it.

    Raises:
        InputError: the motion cannot tell it from the scene, or the camera turns too far.
    """
    if not any(isinstance(each, FlatField) for each in plan.corrections):
        return None
    measured = measure_pixel_gain(source, trajectory, context)
    counts = np.sum([source.counts(span) for span in measured.spans], axis=0) / sum(map(len, measured.spans))
    return Vignette(measured.gain, counts.astype(np.float32), measured.spans, measured.std)


def _look(plan: Plan, source: Source, results: Sequence[LevelResult], reference: int, context: Context) -> Look:
    motion = motion_of_frames(results, source.info, reference)
    source, context = _in_view(plan, source, results, context)
    return Look(source, motion, plan.render.tolerance_px, int(plan.run.memory), context)


def _cut_at(cuts: Sequence[Cut], plan: Plan, found: Estimate) -> Estimate:
    """Estimate the motion again, cut where the image jumps; keep what was known if that explains the photons better.

    All levels run again: with exposures across a jump, the first went astray, too.
    """
    source, context, reference = found.source, found.context, found.look.motion.reference
    timeline = found.timeline.cut_at(cuts)
    try:
        levels = build_levels(plan, source, [])
        results = estimate_motion(
            source, levels, plan.graph, reference, context, plan.until_converged, found.start, timeline, model_of(plan)
        )
        look = _look(plan, source, results, reference, context)
        # Frames that show nothing contradict any motion, and the surer it is the more; such a run is doubtful in any case.
        worse = "" if any(each.dark is not None for each in cuts) else look.worse_than(found.look)
    except (LocationError, CanvasTooLargeError) as error:
        worse = str(error)
    if worse:
        places = ", ".join(f"frame {each.frame}" for each in cuts)
        logger.warning(f"the image seems to jump before {places}, but the motion is not cut there: {worse}")
        return found
    motion = look.motion
    measured = [each.along(motion.trajectory, motion.frame_shape) for each in cuts]
    return replace(found, results=results, timeline=timeline.cut_at(measured), look=look)


def start_of(
    plan: Plan, source: Source, reference: int, decisions: list[Decision], context: Context
) -> ConstantVelocity | None:
    """Return the motion with which the first level starts; None if nothing is known of it.

    Raises:
        InputError: the capture has too few frames to find one.
        LocationError: the spec asks for a constant velocity, and none was found.
    """
    if plan.motion.start == "none":
        return None
    found = find_velocity(source, context)
    halves = " and ".join(f"{np.degrees(each.turn):.4g}" for each in found.halves)
    reason = (
        f"photons merged along it stand out by {found.significance:.2g} standard deviations; the halves of the capture alone "
        f"turn by {halves} degrees a frame"
    )
    decisions.append(Decision(START, found.text, reason))
    return ConstantVelocity(found.velocity, reference)


def model_of(plan: Plan) -> MotionModel:
    """Return what the motion of the camera may be, as a spec says it."""
    camera, distortion = plan.camera, plan.camera.distortion
    k1, k2, p1, p2 = (_given(each) for each in (distortion.k1, distortion.k2, distortion.p1, distortion.p2))
    return MotionModel(plan.motion.model, _given(camera.focal_px), camera.centre_px, (k1, k2, p1, p2))


def _model_decisions(plan: Plan, results: Sequence[LevelResult]) -> list[Decision]:
    """Return which model `auto` took, for the record."""
    located = results[-1].located
    if plan.motion.model != "auto":
        return []
    taken = "homography" if located.solution.rotations is None else "rotation"
    if located.evidence is None:
        return [Decision("motion_model", taken, "the camera turns too far for homographies to one plane")]
    gain = located.evidence.gain
    reason = f"each unknown that homographies have more lowers the squared residuals {gain:.2g} times as much as noise would"
    return [Decision("motion_model", taken, reason)]


def _given(number: float | Literal["find"]) -> float | None:
    return None if number == "find" else number


def _in_view(plan: Plan, source: Source, results: Sequence[LevelResult], context: Context) -> tuple[Source, Context]:
    """Return a capture with the camera that the last level has found, and the context of what is done with it."""
    camera = camera_of_motion(results[-1].trajectory)
    if camera is None:
        return through_lens(source, model_of(plan)), context
    return seen_through(source, camera), replace(context, checkpoints=context.checkpoints.within(camera))


def _reference_frame(plan: Plan, source: Source) -> int:
    n_frames, reference = source.info.n_frames, plan.render.reference
    named = {"first": 0, "middle": n_frames // 2, "last": n_frames - 1}
    return named[reference] if isinstance(reference, str) else reference
