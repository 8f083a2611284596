"""Estimate the motion of a capture: the first level of the loop, then one pass after another on its result."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.corrections.movers import decision_of as background_decision
from photonpano.execution.context import Context
from photonpano.motion.loop import LevelResult
from photonpano.motion.tracking.velocity import ConstantVelocity, find_velocity
from photonpano.pipeline import passes
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.obstacles import timeline_of
from photonpano.pipeline.state import State, model_of
from photonpano.specs.plan import Plan
from photonpano.values import Decision

_MOST_LENSES = 4  # times that the last level is run again, through the lens that it has found
START = "start"  # name of the decision on the initial motion


def estimate(plan: Plan, source: Source, journal: list[Decision], context: Context) -> State:
    """Estimate the motion of a capture, and correct the lens, shading, flicker and cuts that its own frames show.

    `journal` receives the decisions, in the order in which components and passes take them. For errors, see `run`.
    """
    require_centre(plan, source)
    reference, levels = _reference_frame(plan, source), build_levels(plan, source, journal)
    timeline = timeline_of(source, context)
    start = None if plan.motion.start == "none" else _start(source, reference, journal, context)
    state = State(plan, source, context, reference, levels, timeline, model_of(plan), start).located(levels[:1], start)
    tried: tuple[passes.Pass, ...] = (
        passes.through_found_lens,
        passes.without_shading,
        passes.without_movers,
        passes.in_changing_light,
        partial(passes.later_levels, journal=journal),
        *[passes.through_found_lens] * _MOST_LENSES,
        passes.again_without_movers,
        passes.cut_at_jumps,
    )
    for each in tried:
        n_decisions, state = len(state.decisions), passes.tried(state, each).state
        journal += state.decisions[n_decisions:]
    if (background := capture_of(state.source).background) is not None:
        journal.append(background_decision(background))
    journal += [*state.timeline.decisions, *_model_decisions(plan, state.results)]
    return state


def require_centre(plan: Plan, source: Source) -> None:
    """Refuse a principal point that does not lie in the frames: the camera is then that of larger ones."""
    if plan.camera.centre_px is None:
        return
    (x, y), (height, width) = plan.camera.centre_px, source.info.frame_shape
    if not (0 <= x < width and 0 <= y < height):
        raise plan.error(
            "camera.centre_px",
            f"({x:g}, {y:g}) does not lie in the frames of {height}x{width} px; a camera that was calibrated with "
            "other frames has another principal point and focal length here: scale and shift both",
        )


def _reference_frame(plan: Plan, source: Source) -> int:
    n_frames, reference = source.info.n_frames, plan.render.reference
    named = {"first": 0, "middle": n_frames // 2, "last": n_frames - 1}
    return named[reference] if isinstance(reference, str) else reference


def _start(source: Source, reference: int, journal: list[Decision], context: Context) -> ConstantVelocity:
    """Find the constant velocity with which the first level starts; `InputError` or `LocationError` if there is none."""
    found = find_velocity(source, context)
    halves = " and ".join(f"{np.degrees(each.turn):.4g}" for each in found.halves)
    reason = (
        f"photons merged along it stand out by {found.significance:.2g} standard deviations; the halves of the capture alone "
        f"turn by {halves} degrees a frame"
    )
    journal.append(Decision(START, found.text, reason))
    return ConstantVelocity(found.velocity, reference)


def _model_decisions(plan: Plan, results: Sequence[LevelResult]) -> list[Decision]:
    """Return which model `auto` took at the last level, for the record."""
    located = results[-1].located
    if plan.motion.model != "auto" or located.evidence is None:
        return []
    rivals = [f"{name} {rival.chi2:.3g} ({rival.unknowns:,})" for name, rival in located.evidence.rivals.items()]
    reason = "reduced chi-square of the pairs, and the number of unknowns: " + ", ".join(rivals)
    return [Decision("motion_model", located.solution.model.name, reason)]
