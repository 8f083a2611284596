"""Estimate the motion of a capture: the first level of the loop, then one pass after another on its result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from photonpano.capture import capture_of, leaving_out
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.corrections.lighting import decision_of
from photonpano.errors import InputError, LocationError
from photonpano.execution.context import Context
from photonpano.motion.diagnosis import UntiedError, tell_attempt
from photonpano.motion.gyroscope import Gyroscope, fit_rates
from photonpano.motion.level import Timeline
from photonpano.motion.loop import LevelResult
from photonpano.motion.smooth_path import SmoothPath, find_path
from photonpano.motion.velocity import ConstantVelocity, find_velocity
from photonpano.pipeline import passes
from photonpano.pipeline.components import build_levels, foreseen_groups
from photonpano.pipeline.obstacles import ApartError, parts_of, shots_of, timeline_of
from photonpano.pipeline.state import State, model_of, within
from photonpano.residuals.findings import Findings
from photonpano.specs.plan import Plan
from photonpano.text import listed, pixels
from photonpano.values import Decision, FrameSpan, Journal

_MOST_LENSES = 4  # times that the last level is run again, through the lens that it has found
_SHORTENED = 2, 4  # how many times groups are shortened whose exposures are not located


def estimate(plan: Plan, source: Source, journal: Journal, context: Context) -> State:
    """Estimate the motion of a capture, and correct the lens, shading, flicker and cuts that its own frames show.

    `journal` receives the decisions that hold at the end; if there is no motion, those of the last attempt. For errors, see
    `run`.
    """
    require_centre(plan, source)
    attempts: list[Journal] = [[]]
    try:
        return _in_attempts(plan, source, attempts, context)
    finally:
        journal += attempts[-1]


def _in_attempts(plan: Plan, source: Source, attempts: list[Journal], context: Context) -> State:
    """Estimate the motion; where exposures are not located, from a constant velocity, or with shorter groups.

    `attempts` receives the decisions of each attempt.
    """
    in_shots = partial(_in_shots, timeline_of(source, context), plan, source, attempts=attempts, context=context)
    started = plan.motion.start
    try:
        return in_shots(started=started, shortened=1)
    except LocationError as unlocated:
        error = unlocated
    others: list[tuple[str, str, int]] = []
    if started == "none" and plan.motion.prior is None:
        others.append(("motion: {start: constant-velocity}", "constant-velocity", 1))
        # A motion that blurs groups is too fast to be found from rest.
        if isinstance(error, UntiedError) and not error.blurred:
            others.append(("motion: {start: smooth-path}", "smooth-path", 1))
    chosen = any(isinstance(each, str) for each in foreseen_groups(plan, source))
    if chosen and isinstance(error, UntiedError) and error.blurred:
        others += [(f"1/{times} of the group size", started, times) for times in _SHORTENED]
    for what, start, shortened in others:
        try:
            return in_shots(started=start, shortened=shortened)
        except (LocationError, InputError) as failure:
            tell_attempt(error, what, failure)
    raise error


def _in_shots(
    timeline: Timeline, plan: Plan, source: Source, *, attempts: list[Journal], context: Context, started: str, shortened: int
) -> State:
    """Estimate the motion of a capture as one, or in shots if its exposures fall into such."""
    while True:
        try:
            return _along(timeline, plan, source, attempts=attempts, context=context, started=started, shortened=shortened)
        except ApartError as apart:
            shots = apart.shots
        except UntiedError as unlocated:
            if timeline.shots or not (shots := shots_of(source, unlocated.groups, unlocated.parts)):
                raise
        starts = sorted({shot.start for shot in (*timeline.shots, *shots)})
        if len(starts) == len(timeline.shots):
            raise LocationError(
                f"{listed(map(str, shots))} are not tied together, and the longest of them falls apart as well; run parts of "
                "the capture by themselves (source.with.frames)"
            )
        timeline = timeline.in_shots(list(map(FrameSpan, starts, [*starts[1:], source.info.n_frames])))


def _along(
    timeline: Timeline, plan: Plan, source: Source, *, attempts: list[Journal], context: Context, started: str, shortened: int
) -> State:
    """Estimate the motion of the frames that a timeline shows; how it is `started` is a value of `motion.start`."""
    attempts.append([])
    source = replace(leaving_out(source, timeline.shown), copies=timeline.copies)
    if shortened > 1:
        context = within(context, shortened)
    reference = _reference_frame(plan, timeline)
    start, decided = _START[started](plan, source, reference, context)
    levels = build_levels(plan, source, attempts[-1], shortened, start)
    gyroscope, fitted = _gyroscope(plan, source, timeline, context)
    findings = Findings(standing_share=capture_of(source).still.share, start=decided, gyroscope=fitted)
    attempts[-1] += findings.started
    state = State(
        plan=plan,
        source=source,
        context=context,
        reference=reference,
        levels=levels,
        timeline=timeline,
        model=model_of(plan),
        start=start,
        gyroscope=gyroscope,
        shortened=shortened,
        findings=findings,
    )
    state = state.located(levels[:1], start)
    located = state.results[-1].located
    if not timeline.shots and (shots := shots_of(source, located.groups, parts_of(located))):
        raise ApartError(shots)
    tried: tuple[passes.Pass, ...] = (
        passes.through_found_lens,
        passes.without_shading,
        passes.in_changing_light,
        passes.later_levels,
        *[passes.through_found_lens] * _MOST_LENSES,
        passes.again_without_movers,
        passes.cut_at_jumps,
    )
    for each in tried:
        if context.time_limit.leaves_out("further levels, corrections"):
            break
        state = passes.tried(state, each).state
    attempts.append(_decisions(state))
    return state


def _decisions(state: State) -> Journal:
    """Return the decisions that hold for a motion."""
    found, located, light = state.found(), state.results[-1].located, state.light
    decisions = [*(state.levels[0].recorder.decisions or ()), *([] if state.vignette is None else [state.vignette.decision])]
    if light is not None:
        decisions.append(decision_of(light, state.source.info.frame_rate_hz))
    if found.uncut_jump is not None:
        decisions.append(Decision("uncut_jump", found.uncut_jump.px, found.uncut_jump.where))
    decisions += [*found.of_frames, *_model_decisions(state.plan, state.results)]
    if state.gyroscope is not None:
        decisions.append(state.gyroscope.agreement(located.edges, located.solution, float(np.median(located.std_px))))
    return decisions


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


def _reference_frame(plan: Plan, timeline: Timeline) -> int:
    """Return the frame with light that is next to the reference frame, or to the middle of the shot if that holds no such."""
    reference, shot, shown = plan.render.reference, timeline.shot, np.flatnonzero(timeline.shown)
    middle = (shot.start + shot.stop) // 2
    named = {"first": shot.start, "middle": middle, "last": shot.stop - 1}
    frame = named[reference] if isinstance(reference, str) else reference
    return int(shown[np.abs(shown - (frame if shot.start <= frame < shot.stop else middle)).argmin()])


def _no_start(*_: object) -> tuple[None, None]:
    return None, None


def _constant_velocity(plan: Plan, source: Source, reference: int, context: Context) -> tuple[ConstantVelocity, Decision]:
    """Find the constant velocity with which the first level starts; `InputError` or `LocationError` if there is none."""
    found = find_velocity(source, context)
    halves = " and ".join(f"{np.degrees(each.turn):.4g}" for each in found.halves)
    reason = (
        f"photons merged along it stand out by {found.significance:.2g} standard deviations; the halves of the capture alone "
        f"turn by {halves} degrees a frame"
    )
    if plan.motion.start == "none":
        reason += "; without it, pairs of exposures could not be located"
    return ConstantVelocity(found.velocity, reference), Decision("start", found.text, reason)


def _smooth_path(plan: Plan, source: Source, reference: int, context: Context) -> tuple[SmoothPath, Decision]:
    """Find the smooth path with which the first level starts; `InputError` or `LocationError` if there is none."""
    found = find_path(source, reference, context)
    reason = (
        f"photons that it was not fitted to stand out along it by {found.significance:.2g} standard deviations more than in a "
        "still image"
    )
    if plan.motion.start == "none":
        reason += "; without it, pairs of exposures could not be located"
    text = f"shifts along a spline with {found.n_knots} knots, within {pixels(found.trajectory.std_px)} px"
    return found.trajectory, Decision("start", text, reason)


_START: Mapping[str, Callable[[Plan, Source, int, Context], tuple[Trajectory | None, Decision | None]]] = {
    "none": _no_start,
    "constant-velocity": _constant_velocity,
    "smooth-path": _smooth_path,
}


def _gyroscope(
    plan: Plan, source: Source, timeline: Timeline, context: Context
) -> tuple[Gyroscope, Decision] | tuple[None, None]:
    """Fit the gyroscope of a spec to its capture; `InputError` or `LocationError` if it was not fixed to its camera."""
    if (prior := plan.motion.prior) is None:
        return None, None
    camera, noise = model_of(plan).camera(source.info.frame_shape), float(np.radians(prior.noise_deg_s_sqrt_hz))
    return fit_rates(
        source,
        prior.imu,
        camera,
        timeline=timeline,
        context=context,
        noise=noise,
        axes=prior.axes,
        offset_s=prior.time_offset_s,
    )


def _model_decisions(plan: Plan, results: Sequence[LevelResult]) -> list[Decision]:
    """Return which model `auto` took at the last level, for the record."""
    located = results[-1].located
    if plan.motion.model != "auto":
        return []
    rivals = [f"{name} {rival.deviance:,.0f} ({rival.unknowns:,})" for name, rival in located.rivals.items()]
    walks = [f"{name} {pixels(px)} px" for name, px in located.solution.walks_px.items()]
    reason = f"beyond shift and roll, the ends of a frame move by {listed(walks) or 'nothing'} over the capture"
    if (focal_px := located.solution.turning_px) is not None and walks:
        reason += f", and perspective follows the shift: a camera of about {focal_px:,.0f} px that turns and travels"
    if len(rivals) > 1:
        reason += f"; deviances of the models, and their unknowns: {', '.join(rivals)}"
    return [Decision("motion_model", located.solution.model.name, reason)]
