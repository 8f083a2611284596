"""Checks of executors: tasks have the same results as in this process."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from operator import itemgetter
from typing import Any, ClassVar

import numpy as np
import pytest

from photonpano.capture import PluginSource
from photonpano.errors import LocationError
from photonpano.execution import CaptureElsewhere, Executor
from photonpano.execution.context import Context
from photonpano.plugins.contributions import ExecutorContext, ExecutorContribution
from photonpano.testing.captures import MemorySource
from photonpano.testing.conformance import Conformance
from photonpano.values import Counts, FrameSpan

N_FRAMES, SPAN = 30, FrameSpan(3, 20)


@cache
def capture() -> PluginSource:
    """Return a small capture, the same in every process."""
    frames = np.random.default_rng(0).random((N_FRAMES, 12, 16)) < 0.3
    return PluginSource(MemorySource(frames), "a capture of photonpano.testing")


def counted(source: PluginSource, span: FrameSpan) -> Counts:
    """Sum the frames of a span: a task."""
    return source.counts(span)


def divided(counts: Counts, by: int) -> tuple[Counts, int]:
    """Return a quotient, and the sum of the remainders: a task with two results."""
    return counts // np.uint32(by), int((counts % np.uint32(by)).sum())


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
        """The executor, built for the capture of this module."""
        checks = cls()
        checks.require_libraries()
        context = ExecutorContext(2, CaptureElsewhere(capture(), capture), here={}, elsewhere=dict)
        executor = checks.contribution.build(checks.settings(), context)
        yield executor
        executor.close()

    def test_task_sees_the_capture(self, executor: Executor) -> None:
        """Frames are those that this process reads."""
        np.testing.assert_array_equal(executor.call(counted, capture(), SPAN), capture().counts(SPAN))

    def test_shared_values_are_given_to_many_tasks(self, executor: Executor) -> None:
        """A shared value may be the function of a task, or be given to it; results come in order."""
        items = np.arange(20).tolist()
        shared = executor.share({each: each**2 for each in items})
        assert [executor.call(dict.get, shared, each) for each in items] == [each**2 for each in items]
        context = Context(max(1, executor.under_way), executor=executor)
        for number in (20, 1000):
            assert list(context.in_order(itemgetter(1), [(0, each) for each in range(number)])) == list(range(number))

    def test_kept_results_are_given_to_other_tasks(self, executor: Executor) -> None:
        """The first of two results stays where it was made; tasks that it is given to see its value."""
        counts = capture().counts(SPAN)
        kept, remainder = executor.keep(divided, counts, 3)
        quotient, expected = divided(counts, 3)
        assert remainder == expected
        again: Any = executor.call(divided, kept, 2)
        np.testing.assert_array_equal(again[0], quotient // np.uint32(2))

    def test_error_of_a_task_arrives(self, executor: Executor) -> None:
        """With its class and its message, so that a run ends as it does in threads."""
        with pytest.raises(LocationError, match="no exposure overlaps"):
            executor.call(lost, "no exposure overlaps")
        assert executor.call(len, [1, 2]) == 2
