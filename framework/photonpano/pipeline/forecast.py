"""How long a run will take, and how much memory: a trial on a part of the capture, multiplied."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from photonpano.context import Context
from photonpano.merging.panorama import BYTES_PER_PIXEL, plan_canvas, render
from photonpano.motion.loop import LevelResult, estimate_motion, resample
from photonpano.pipeline.components import build_levels
from photonpano.pipeline.record import peak_memory_bytes
from photonpano.protocols import LinearlyCorrectedSource, PackedSource, Source
from photonpano.specs.plan import Plan
from photonpano.threads import Stopwatch, one_thread_inside, thread_count
from photonpano.values import BoolArray, Counts, FluxImage, Frames, FrameSpan, Response, StreamInfo

TRIAL_GROUPS = 12
"""So many groups of the first level, from the middle of the capture, are run through all levels."""
_WARM_UP_GROUPS = 3
"""So many are run before, so that what is done once, such as to compile loops, does not count."""
BYTES_PER_FRAME = 1200
"""What is kept of the motion of each frame, as measured in the benchmarks."""


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run is expected to take.

    Attributes:
        tried: the frames of the trial.
        threads: how many threads it ran with.
        seconds: of each level, and of the panorama.
        memory_bytes: the peak of the process, as far as the system tells it.
        canvas: (height, width) of the panorama, if the camera goes on as in the trial and never comes back.
    """

    tried: FrameSpan
    threads: int
    seconds: dict[str, float]
    memory_bytes: int
    canvas: tuple[int, int]


class PartOfSource:
    """Some frames of a capture, numbered from 0. It has `packed` and `corrected` if the capture has them."""

    packed: Callable[[FrameSpan], NDArray[np.uint8]]
    corrected: Callable[[Counts, int], FluxImage]

    def __init__(self, source: Source, span: FrameSpan) -> None:
        self._source, self._start = source, span.start
        self.info: StreamInfo = replace(source.info, n_frames=len(span))
        self.response: Response = source.response
        self.valid: BoolArray = source.valid
        if isinstance(source, PackedSource):
            self.packed = lambda span: source.packed(self._there(span))
        if isinstance(source, LinearlyCorrectedSource):
            self.corrected = source.corrected

    def counts(self, span: FrameSpan) -> Counts:
        """Sum the frames of a span: (H, W) uint32."""
        return self._source.counts(self._there(span))

    def frames(self, span: FrameSpan) -> Frames:
        """Return the frames of a span one by one: (n, H, W)."""
        return self._source.frames(self._there(span))

    def close(self) -> None:
        """Do nothing: the capture belongs to somebody else."""

    def __enter__(self) -> PartOfSource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _there(self, span: FrameSpan) -> FrameSpan:
        self.info.require(span)
        return FrameSpan(span.start + self._start, span.stop + self._start)


def forecast(plan: Plan, source: Source) -> Forecast:
    """Run all levels on a part of the capture, and multiply: time grows with the number of frames.

    Raises:
        PhotonpanoError: the run would fail there.
    """
    threads, n_frames = thread_count(plan.run.threads), source.info.n_frames
    groups = resample(build_levels(plan, source, [])[0], n_frames, Stopwatch(threads))
    length = float(np.median([len(group.span) for group in groups]))
    _tried(plan, PartOfSource(source, _middle(n_frames, round(_WARM_UP_GROUPS * length))), threads)
    span = _middle(n_frames, round(TRIAL_GROUPS * length))
    part, more = PartOfSource(source, span), n_frames / len(span)
    results = _tried(plan, part, threads)
    seconds = {f"level {result.level.number}": sum(result.seconds.values()) * more for result in results}
    start = time.perf_counter()
    canvas = plan_canvas(results[-1].trajectory, part.info.span, part.info.frame_shape, plan.render.scale, int(plan.run.memory))
    with one_thread_inside():
        render(part, results[-1].trajectory, part.info.span, canvas, plan.render.tolerance_px, Context(threads))
    seconds["panorama"] = (time.perf_counter() - start) * more
    sides = [
        round(side * plan.render.scale + (whole - side * plan.render.scale) * more)
        for side, whole in zip(part.info.frame_shape, canvas.shape, strict=True)
    ]
    rendering = min(BYTES_PER_PIXEL * sides[0] * sides[1], int(plan.run.memory))
    memory = (peak_memory_bytes() or 0) + n_frames * BYTES_PER_FRAME + rendering
    return Forecast(span, threads, seconds, memory, (sides[0], sides[1]))


def _tried(plan: Plan, part: PartOfSource, threads: int) -> list[LevelResult]:
    levels = build_levels(plan, part, [])
    with one_thread_inside():
        return estimate_motion(part, levels, plan.graph, part.info.n_frames // 2, Context(threads), plan.until_converged)


def _middle(n_frames: int, length: int) -> FrameSpan:
    length = min(n_frames, length)
    start = (n_frames - length) // 2
    return FrameSpan(start, start + length)
