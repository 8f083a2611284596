"""Forecast the time and memory of a run from a trial on a part of the capture."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from photonpano.capture import part_of
from photonpano.contracts.protocols import Source, camera_of_motion
from photonpano.errors import PhotonpanoError
from photonpano.execution.context import Context, Progress
from photonpano.execution.threads import Stopwatch, one_thread_inside, thread_count
from photonpano.geometry import Canvas, canvas_of_box
from photonpano.merging.colour import channels_of
from photonpano.merging.panorama import View, box_of, plan_canvas, render
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.loop import resample
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.estimate import estimate
from photonpano.pipeline.passes import build_refiners, refine
from photonpano.pipeline.rendering import build_renderer
from photonpano.pipeline.state import State
from photonpano.record.run_json import peak_memory_bytes
from photonpano.specs.plan import Plan
from photonpano.values import FrameSpan

TRIAL_GROUPS = 12  # length of the trial in the middle of the capture, in groups of the first level
_WARM_UP_GROUPS = 3  # length of an untimed trial before it, in groups, so that compiling is not timed
BYTES_PER_FRAME = 1200  # memory of the motion of a frame, measured in benchmarks


@dataclass(frozen=True, slots=True)
class Forecast:
    """The expected time and memory of a run.

    Attributes:
        tried: the frames of the trial.
        threads: the number of threads of the trial.
        seconds: expected time of each level, of what corrects the capture between them, of the residuals, and of the panorama.
        memory_bytes: expected peak memory of the process.
        canvas: (height, width) of the panorama if the camera keeps moving as in the trial and never returns; of a part of it
            (`render.extent`), that of the part.
    """

    tried: FrameSpan
    threads: int
    seconds: dict[str, float]
    memory_bytes: int
    canvas: tuple[int, int]


def forecast(plan: Plan, source: Source, progress: Progress) -> Forecast:
    """Run all of the pipeline on a part of the capture, and extrapolate: time is proportional to the number of frames.

    Raises the `PhotonpanoError` of a trial that failed, as the run would.
    """
    threads, n_frames = thread_count(plan.run.threads), source.info.n_frames
    context = Context(threads=threads, progress=progress)
    groups = resample(build_levels(plan, source, [])[0], n_frames, Stopwatch())
    length = float(np.median([len(group.span) for group in groups]))
    with suppress(PhotonpanoError):  # what fails here fails in the trial, too, or is too short for it
        _tried(plan, part_of(source, _middle(n_frames, round(_WARM_UP_GROUPS * length))), context)
    span = _middle(n_frames, round(TRIAL_GROUPS * length))
    part, more = part_of(source, span), n_frames / len(span)
    state, motion, elapsed = _tried(plan, part, context)
    seconds = {f"level {result.level.number}": sum(result.seconds.values()) * more for result in state.results}
    seconds["corrections"] = max(elapsed[0] * more - sum(seconds.values()), 0.0)
    seconds["residuals"] = elapsed[1] * more
    start = time.perf_counter()
    seen, trajectory, scale = state.view.source, motion.trajectory, plan.render.scale
    renderer = build_renderer(plan, seen, [])
    bytes_per_pixel = renderer.bytes_per_pixel * channels_of(seen)
    camera = camera_of_motion(trajectory)
    view = View(plan.render.projection, plan.render.horizon == "level", camera, turns=camera is not None)
    memory = int(plan.run.memory)
    canvas = plan_canvas(trajectory, part.info.span, part.info.frame_shape, scale, memory, bytes_per_pixel, view=view)
    with one_thread_inside():
        render(
            seen,
            trajectory,
            part.info.span,
            canvas,
            tolerance_px=plan.render.tolerance_px,
            context=context,
            renderer=renderer,
        )
    seconds["panorama"] = (time.perf_counter() - start) * more
    height, width = _expected_shape(plan, part.info.frame_shape, canvas, more)
    rendering = min(bytes_per_pixel * height * width, memory)
    memory_bytes = (peak_memory_bytes() or 0) + n_frames * BYTES_PER_FRAME + rendering
    return Forecast(span, threads, seconds, memory_bytes, (height, width))


def _expected_shape(plan: Plan, frame_shape: tuple[int, int], tried: Canvas, more: float) -> tuple[int, int]:
    """Return the (height, width) of the panorama, from that of the trial, which has `1 / more` of the frames.

    On a cylinder or a sphere it is the whole panorama, up to a full turn, and as high as that of the trial.
    """
    scale, extent = plan.render.scale, plan.render.extent
    if extent != "panorama" and tried.planar:
        return canvas_of_box(box_of(extent, frame_shape), scale).shape
    height, width = (
        round(side * scale + (whole - side * scale) * more) for side, whole in zip(frame_shape, tried.shape, strict=True)
    )
    return (height, width) if tried.period_px is None else (tried.height, min(width, round(tried.period_px)))


def _tried(plan: Plan, part: Source, context: Context) -> tuple[State, FrameMotion, tuple[float, float]]:
    """Estimate and refine the motion of a part, as a run does; also return the seconds that both took."""
    start = time.perf_counter()
    with one_thread_inside():
        state = estimate(plan, part, [], context)
        estimated = time.perf_counter()
        state, explained = refine(state, build_refiners(plan, state.view.source, []))
    return state, explained.motion, (estimated - start, time.perf_counter() - estimated)


def _middle(n_frames: int, length: int) -> FrameSpan:
    length = min(n_frames, length)
    start = (n_frames - length) // 2
    return FrameSpan(start, start + length)
