"""How a long computation runs: number of threads, progress, callbacks, and what it keeps for the case of an interruption."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import Any, Protocol, TypeVar

from photonpano.execution.threads import batched, in_order, thread_pool
from photonpano.notebooks import NotebookBars, in_notebook
from photonpano.values import Journal

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")
# Items of a task. An exposure takes some ten milliseconds, and a task costs about three in a client and its scheduler.
_MOST_AT_ONCE = 8
# Items are worked on at once where there are this many tasks for each one under way, so that no worker waits for the last.
_TASKS_UNDER_WAY = 4


class Progress(Protocol):
    """Shows stages as they advance, and messages. Stages do not overlap; calls may come from any thread."""

    def stage(self, title: str, total: int, unit: str) -> AbstractContextManager[Callable[[int], None]]:
        """Enter a stage of `total` units, such as "level 2: locate" of 81 exposures; call the value with units done."""

    def note(self, message: str) -> None:
        """Show one line, such as the result of a level or a warning."""


class Quiet:
    """Progress that shows nothing."""

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Ignore a stage."""
        del title, total, unit
        yield lambda _: None

    def note(self, message: str) -> None:
        """Ignore a line."""


def usual(progress: Progress | None) -> Progress:
    """Return the progress that is given or, for None, the usual one: bars in a notebook, and nothing elsewhere."""
    return progress or (NotebookBars() if in_notebook() else Quiet())


class Log(Protocol):
    """The results of one step, in order: first those that an interrupted computation kept, then those that are added."""

    @property
    def found(self) -> Sequence[Any]:
        """The results that were kept before; the first that is added is the next one."""

    def add(self, result: Any) -> None:
        """Keep the next result."""

    def finish(self) -> None:
        """Mark the step as finished: there are no more results."""


class Checkpoints(Protocol):
    """Keeps what a computation finds, so that it can go on after an interruption.

    A result is found again by the name of its step and by everything that it depends on: numbers, texts, arrays, and the
    dataclasses and sequences that hold them. It is the same to the last bit. Components, settings and capture are given by the
    run, and need not be repeated.
    """

    def once(self, step: str, compute: Callable[[], ResultT], *given: Any, decisions: Journal | None = None) -> ResultT:
        """Return the result of a step: the one that was kept, or else the one that `compute` returns, which is kept.

        What it adds to `decisions` is kept, too, and added again where the result is found.
        """

    def log(self, step: str, *given: Any, decisions: Journal | None = None) -> Log:
        """Open the results of a step that has many of them; for `decisions`, see `once`."""

    def within(self, *given: Any) -> Checkpoints:
        """Return checkpoints whose results depend on more."""


class NoLog:
    """A log that is never kept."""

    found: tuple[()] = ()

    def add(self, result: Any) -> None:
        """Keep nothing."""

    def finish(self) -> None:
        """Keep nothing."""


class KeepNothing:
    """Checkpoints that are never kept."""

    def once(self, step: str, compute: Callable[[], ResultT], *given: Any, decisions: Journal | None = None) -> ResultT:
        """Compute the result."""
        del step, given, decisions
        return compute()

    def log(self, step: str, *given: Any, decisions: Journal | None = None) -> Log:
        """Open an empty log."""
        del step, given, decisions
        return NoLog()

    def within(self, *given: Any) -> KeepNothing:
        """Return the same."""
        del given
        return self


@dataclass(slots=True, eq=False)
class TimeLimit:
    """The time after which a run begins nothing that it can do without."""

    ends: float = math.inf  # by `time.perf_counter`
    left_out: list[str] = field(default_factory=list)

    def leaves_out(self, what: str) -> bool:
        """Return whether the time is over, and remember what is left out then."""
        if time.perf_counter() < self.ends:
            return False
        if what not in self.left_out:
            self.left_out.append(what)
        return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """How a computation runs; its result does not depend on it."""

    threads: int = 1  # how many tasks are under way at once
    progress: Progress = field(default_factory=Quiet)
    # called with the `LevelResult` of each level of the loop when it is done
    on_level: Callable[[Any], object] = lambda _: None
    checkpoints: Checkpoints = field(default_factory=KeepNothing)  # keep what is found, for the case of an interruption
    executor: Executor | None = None  # works on the tasks; None for threads of this process
    time_limit: TimeLimit = field(default_factory=TimeLimit)

    def in_order(self, work: Callable[[ItemT], ResultT], items: Iterable[ItemT]) -> Iterator[ResultT]:
        """Yield the results of `work` in the order of the items, in tasks of the executor: see `threads.in_order`."""
        at_once = self.at_once(len(items)) if isinstance(items, Sequence) else 1
        batches = batched(items, at_once)
        return chain.from_iterable(in_order(partial(_each, work), batches, self.threads, self.executor))

    def at_once(self, number: int) -> int:
        """Return how many of a number of items are best worked on in one task; all workers have several tasks all the same."""
        return 1 if self.executor is None else min(_MOST_AT_ONCE, max(1, number // (_TASKS_UNDER_WAY * self.threads)))

    def pool(self) -> AbstractContextManager[Executor]:
        """Open what works on tasks for a block: the executor, or threads that end with the block."""
        return thread_pool(self.threads) if self.executor is None else nullcontext(self.executor)


def _each(work: Callable[[ItemT], ResultT], items: Iterable[ItemT]) -> list[ResultT]:
    return [work(item) for item in items]
