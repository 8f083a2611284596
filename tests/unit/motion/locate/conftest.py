"""A level of twelve exposures with a known motion, of which some pairs may fail."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, Trajectory
from photonpano.execution.context import Context
from photonpano.execution.threads import Stopwatch
from photonpano.geometry import inverse, translation
from photonpano.motion.level import Level, Timeline, VirtualExposures
from photonpano.motion.locate import LocatedLevel, LoopSetting, locate
from photonpano.specs.settings import GraphSettings
from photonpano.testing import KnownMotion

SHAPE = (40, 60)
N_FRAMES = 120
CHAIN = GraphSettings(skips=())


@pytest.fixture(scope="module")
def source(memory_source: type) -> Any:
    return memory_source(np.zeros((N_FRAMES, *SHAPE)))


@pytest.fixture
def run(source: Any) -> Callable[..., LocatedLevel]:
    def run(
        level: Level,
        previous: Trajectory | None = None,
        graph: GraphSettings = CHAIN,
        threads: int = 2,
        known: FrameSpan | None = None,
    ) -> LocatedLevel:
        groups = level.resampler.groups(N_FRAMES, level.number)
        exposures = VirtualExposures(
            level=level, source=source, groups=groups, previous=previous, clock=Stopwatch(), known=known
        )
        setting = LoopSetting(
            source=source, graph=graph, context=Context(threads=threads), reference=0, timeline=Timeline.regular(N_FRAMES)
        )
        return locate(exposures, setting)

    return run


@pytest.fixture
def failing() -> Callable[..., Any]:
    """Make an answer that fails for every pair of these exposures."""

    def failing(*lost: int) -> Callable[..., Any]:
        def answer(moving: Group, fixed: Group, found: Located) -> Located | NotLocated:
            return NotLocated("lost") if {moving.span.start // 10, fixed.span.start // 10} & set(lost) else found

        return answer

    return failing


def _truth(moving: Group, fixed: Group, found: Located) -> Located:
    return found


class Second:
    """A fallback that knows the motion, records what it describes, and returns what `answer` makes of the motion."""

    def __init__(self, answer: Callable[..., Any] = _truth, px_per_frame: float = 0.3) -> None:
        self._motion, self._answer = KnownMotion(lambda frame: translation(px_per_frame * frame, 0)), answer
        self.shown: list[int] = []

    def describe(self, exposure: Any) -> Any:
        time.sleep(0.002)  # long enough that two threads that ask for the same one would meet
        self.shown.append(exposure.group.span.start // 10)
        return exposure

    def register(self, moving: Any, fixed: Any, initial: np.ndarray | None) -> Any:
        to_plane = self._motion.at([moving.group.reference, fixed.group.reference])
        return self._answer(moving.group, fixed.group, Located(inverse(to_plane[1]) @ to_plane[0]))


@pytest.fixture
def make_second() -> type[Second]:
    return Second
