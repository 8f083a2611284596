"""Build the components of a plan, each once, with errors that name the plugin."""

from __future__ import annotations

import importlib.util
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property, partial
from typing import Any

from photonpano.capture import Capture, capture_of, part_of
from photonpano.contracts.attribution import attributed
from photonpano.contracts.protocols import Resampler, Source, Trajectory, light_of
from photonpano.contracts.requirements import shown
from photonpano.corrections import Mask, corrected_source, without_still_pixels
from photonpano.errors import CaptureUnreadError, InputError, PhotonpanoError, PluginError, SpecError, described
from photonpano.execution.threads import in_order, thread_count
from photonpano.motion.level import Level, NamedLocator, Recorder
from photonpano.plugins.contributions import (
    KINDS,
    ExecutorContext,
    MergerContribution,
    PartOfCapture,
    SourceContext,
    StageContext,
    install_command,
)
from photonpano.specs.builtin import check_stream
from photonpano.specs.plan import Choice, Plan
from photonpano.text import listed
from photonpano.values import CaptureSummary, FrameSpan, Group, Journal

HALVED_LEVELS = 2  # with `scale: auto`, the first two levels are located at half size
LARGE_FRAME_PX = 192  # minimum shorter side of frames located at half size: the pyramids of locators need pixels


@contextmanager
def open_source(plan: Plan, look: bool = True) -> Iterator[Capture]:
    """Open the capture of a plan, and check the stages against it. With `corrections: auto`, what stands still is masked.

    Without `look`, no frame is read, and corrections that depend on frames are left out. Errors are those of `build_source`,
    and `SpecError` if a stage does not suit the capture.
    """
    with build_source(plan, look) as opened:
        capture = without_still_pixels(opened, look) if plan.corrects_itself else opened
        problems = check_stream(plan, capture.info)
        if plan.render.white_balance != "none" and capture.colour is None:
            message = "the capture is grey; remove this key, or name the colour filter: corrections: [{colour-filter: {...}}]"
            problems.append(plan.place("render.white_balance").problem(message))
        if problems:
            raise SpecError(problems)
        yield capture


def build_source(plan: Plan, look: bool = True) -> Capture:
    """Open the capture of a plan, with its corrections. For `look`, see `open_source`.

    Raises:
        InputError: the capture cannot be used as it is.
        PluginError: a library is missing, or the plugin failed in its own way.
        SpecError: a correction does not suit the capture, or its file is not what it should be.
    """
    try:
        opened = built(plan.source, SourceContext(plan.run.seed, thread_count(plan.run.threads)))
        whole = capture_of(opened, plan.source.label)
        for index, each in enumerate(plan.corrections):
            if isinstance(each, Mask):
                _require_frames(plan, whole, f"corrections.{index}.mask.frames", each.frames)
        capture = _part(plan, whole)
    except InputError as error:
        if (found := plan.recognised) is None:
            raise
        # The spec says `auto`, so the message explains how this source was chosen.
        raise InputError(f"{error} (source {found.value}: {found.reason})") from error
    if not plan.corrections:
        return capture

    def located(index: int, message: str) -> SpecError:
        where = f"corrections.{index}"
        return SpecError([plan.place(where).problem(message)])

    try:
        return corrected_source(capture, plan.corrections, located, look)
    except BaseException:
        capture.close()
        raise


def _part(plan: Plan, capture: Capture) -> Capture:
    """Return the frames that `source.with.frames` names; all if it names none."""
    config = plan.source.config
    if not isinstance(config, PartOfCapture) or config.frames is None:
        return capture
    _require_frames(plan, capture, "source.with.frames", config.frames)
    return part_of(capture, FrameSpan(*config.frames))


def _require_frames(plan: Plan, capture: Capture, where: str, frames: tuple[int, int] | None) -> None:
    """Raise `SpecError` if a key names frames that a capture does not have; the capture is closed then."""
    n_frames = capture.info.n_frames
    if frames is not None and frames[1] > n_frames:
        capture.close()
        message = f"the capture has {n_frames} frames: expected [start, stop] with stop up to {n_frames}, got {list(frames)}"
        raise SpecError([plan.place(where).problem(message)])


def build_levels(
    plan: Plan, source: Source, decisions: Journal, shortened: int = 1, start: Trajectory | None = None
) -> tuple[Level, ...]:
    """Build the components of all levels; those with the same config are shared. `decisions` receives their choices.

    Groups whose size is chosen from the capture are `shortened` that many times. Along a smooth path with which the first
    level starts, they are blurred by its error alone.
    """
    light = light_of(source)
    period = 1 / light.frequency if light is not None and light.frequency else None
    capture = _Once(partial(_summary, source, thread_count(plan.run.threads), start, period_frames=period, shortened=shortened))
    recorder = Recorder(decisions)
    context = stage_context(plan, source, recorder, capture)
    made: list[tuple[Choice, Any]] = []

    def component(choice: Choice) -> Any:
        for known, value in made:
            if known.contribution is choice.contribution and known.config == choice.config:
                return value
        value = built(choice, context)
        made.append((choice, value))
        return value

    def of_level(choice: Choice, number: int) -> Any:
        return attributed(component(choice), choice.label, f"level {number}")

    return tuple(
        Level(
            number=number,
            scale=scale_of(plan, number, source.info.frame_shape),
            resampler=of_level(level.resample, number),
            merger=of_level(level.merge, number),
            locators=tuple(
                NamedLocator(name, of_level(each, number)) for name, each in _named((level.locate, *level.fallbacks))
            ),
            interpolator=of_level(level.interpolate, number),
            recorder=recorder,
            handles_movers=isinstance(level.merge.contribution, MergerContribution) and level.merge.contribution.handles_movers,
        )
        for number, level in enumerate(plan.levels, start=1)
    )


def build_finder(plan: Plan, source: Source, decisions: Journal) -> Any:
    """Build what finds something else than a panorama, for a plan of such a kind; `decisions` receives its choices."""
    from photonpano.pipeline.summary import summarise  # imports OpenCV, which is not needed to check a spec

    assert plan.finder is not None
    capture = _Once(lambda: summarise(source, thread_count(plan.run.threads)))
    return built(plan.finder, stage_context(plan, source, Recorder(decisions), capture), "the capture")


def scale_of(plan: Plan, number: int, frame_shape: tuple[int, int]) -> float:
    """Return the scale of a level's exposures; `number` counts from 1.

    With `scale: auto`, the first two levels are located at half size if frames are large and a later level refines the motion.
    While the motion is known to about a pixel only, a quarter of the pixels locates it nearly as well.
    """
    scale = plan.levels[number - 1].scale
    if scale != "auto":
        return scale
    refined = number <= HALVED_LEVELS and number < len(plan.levels)
    return 0.5 if refined and min(frame_shape) >= LARGE_FRAME_PX else 1.0


def _summary(source: Source, threads: int, start: Trajectory | None, **known: Any) -> CaptureSummary:
    """Summarise a capture whose image is followed along a start, if that is a smooth path."""
    from photonpano.motion.smooth_path import SmoothPath  # both import OpenCV, which is not needed to check a spec
    from photonpano.pipeline.summary import summarise

    found = replace(summarise(source, threads), **known)
    if not isinstance(start, SmoothPath):
        return found
    return replace(found, speed_px=start.error_px_a_frame, how="the error of the path that is followed", away_frames=None)


def foreseen_groups(plan: Plan, source: Source) -> list[tuple[Group, ...] | str]:
    """Return the groups of each level, or a clause that explains why they depend on the frames. Reads no frames."""
    context = StageContext(source.info, source.response, plan.run.seed)
    foreseen: list[tuple[Group, ...] | str] = []
    for number, level in enumerate(plan.levels, start=1):
        resampler: Resampler = built(level.resample, context, f"level {number}")
        try:
            foreseen.append(resampler.groups(source.info.n_frames, number))
        except CaptureUnreadError as error:
            foreseen.append(str(error))
    return foreseen


def foreseen_decisions(plan: Plan, source: Source, capture: CaptureSummary) -> Journal:
    """Return the decisions of the first level's resampler, such as its group size, for a capture with this summary."""
    decisions: Journal = []
    context = stage_context(plan, source, Recorder(decisions), lambda: capture)
    resampler: Resampler = built(plan.levels[0].resample, context, "level 1")
    resampler.groups(source.info.n_frames, 1)
    return decisions


def stage_context(
    plan: Plan, source: Source, recorder: Recorder, capture: Callable[[], CaptureSummary] | None = None
) -> StageContext:
    """Return what components are built for; without `capture`, they cannot ask for its flux and speed."""
    threads = thread_count(plan.run.threads)
    at_once = partial(in_order, threads=threads)
    context = StageContext(source.info, source.response, plan.run.seed, threads, decide=recorder, in_order=at_once)
    return context if capture is None else replace(context, capture=capture)


class _Once:
    """Measures a capture at the first call; where a component travels to, it has been measured."""

    def __init__(self, measure: Callable[[], CaptureSummary]) -> None:
        self._measure = measure

    def __call__(self) -> CaptureSummary:
        """Return the summary of the capture."""
        return self._summary

    @cached_property
    def _summary(self) -> CaptureSummary:
        return self._measure()

    def __reduce__(self) -> tuple[type[_Once], tuple[Callable[[], CaptureSummary]]]:
        return _Once, (partial(_itself, self._summary),)


def _itself(value: Any) -> Any:
    return value


def _named(choices: Iterable[Choice]) -> Iterator[tuple[str, Choice]]:
    """Yield each choice with its name; the second of the same name is numbered, such as "opencv-sift 2"."""
    seen: Counter[str] = Counter()
    for choice in choices:
        name = choice.contribution.name
        seen[name] += 1
        yield (name if seen[name] == 1 else f"{name} {seen[name]}"), choice


def built(choice: Choice, context: SourceContext | StageContext | ExecutorContext, where: str = "") -> Any:
    """Build a component, `attributed` if the run says `where` it works.

    Raises:
        PluginError: a library is missing, or the plugin failed in its own way.
    """
    contribution = choice.contribution
    who = choice.label
    for requirement in contribution.requires:
        if importlib.util.find_spec(requirement.module) is None:
            raise PluginError(f"{who} needs {requirement.module}, which is not installed: {install_command([requirement])}")
    try:
        component = contribution.build(choice.config, context)
        lacking = [name for name in KINDS[contribution.kind].methods if not callable(getattr(component, name, None))]
    except PhotonpanoError:
        raise
    except Exception as error:
        raise PluginError(f"{who} could not be built: {described(error)}") from error
    if lacking:
        problem = f"build returned {shown(component)}, which has no {listed(lacking, 'nor')}"
        if hasattr(component, "share"):  # of executors until 0.2
            problem += "; return a concurrent.futures.Executor in place of one that has `share` and `keep`"
        raise PluginError(f"{who} could not be built: {problem}")
    return attributed(component, who, where) if where else component
