"""Checks of executors: tasks have the same results as in this process."""

from __future__ import annotations

import operator
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import lru_cache, partial
from typing import ClassVar

import numpy as np
import pytest

from photonpano.capture import PluginSource
from photonpano.errors import LocationError
from photonpano.execution.context import Context
from photonpano.execution.threads import submitted
from photonpano.plugins.contributions import ExecutorContext, ExecutorContribution
from photonpano.testing.captures import MemorySource
from photonpano.testing.conformance import Conformance
from photonpano.values import Counts, FrameSpan

N_FRAMES, SPAN = 40, FrameSpan(3, 30)


@lru_cache
def capture() -> PluginSource:
    """Return a small capture, the same in each process, which travels as this function."""
    frames = np.random.default_rng(0).random((N_FRAMES, 24, 32)) < 0.3
    source = PluginSource(MemorySource(frames), "a capture of photonpano.testing")
    source.opener = capture
    return source


def counted(source: PluginSource, span: FrameSpan) -> Counts:
    """Sum the frames of a span: a task."""
    return source.counts(span)


def lost(reason: str) -> None:
    """Fail: a task."""
    raise LocationError(reason)


class ExecutorConformance(Conformance):
    """Checks of an executor."""

    kind: ClassVar[str] = "executor"

    contribution: ExecutorContribution

    @pytest.fixture(scope="class")
    @classmethod
    def executor(cls) -> Iterator[Executor]:
        """The executor, built for two threads."""
        checks = cls()
        checks.require_libraries()
        executor = checks.contribution.build(checks.settings(), ExecutorContext(2))
        yield executor
        executor.shutdown(cancel_futures=True)

    def test_task_sees_the_capture(self, executor: Executor) -> None:
        """Frames are those that this process reads."""
        np.testing.assert_array_equal(submitted(executor, counted, capture(), SPAN).result(), capture().counts(SPAN))

    def test_results_come_in_order(self, executor: Executor) -> None:
        """Tasks have the results of their own items, alone and many at once."""
        context = Context(threads=max(1, getattr(executor, "under_way", 2)), executor=executor)
        for number in (20, 1000):
            assert list(context.in_order(partial(operator.add, 3), range(number))) == list(range(3, number + 3))

    def test_error_of_a_task_arrives(self, executor: Executor) -> None:
        """With its class and its message, so that a run ends as it does in threads."""
        with pytest.raises(LocationError, match="no exposure overlaps"):
            executor.submit(lost, "no exposure overlaps").result()
        assert executor.submit(len, [1, 2]).result() == 2
