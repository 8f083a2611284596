"""The interface of executors, and the one of a single process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

ValueT = TypeVar("ValueT")
ResultT = TypeVar("ResultT")


class Executor(Protocol):
    """Works on the tasks of a run. May be called from several threads; each call returns when its task is done.

    A task is a function and what is given to it. The function, and each thing that is given, may be what `share` or `keep` has
    returned, and stands for a value. Results do not depend on the executor.
    """

    @property
    def under_way(self) -> int:
        """How many tasks are worth having under way at once."""

    def at_once(self, number: int) -> int:
        """Return how many of a number of items are best worked on in one task: more than one where tasks cost time to send."""

    def share(self, value: ValueT) -> ValueT:
        """Return what stands for a value, which may be large, in tasks: it travels to each worker once."""

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task, and return its result."""

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results: the first stays where it was made, and what is returned stands for it in tasks."""

    def close(self) -> None:
        """Cancel what is under way, and release what was started for the run."""


class LocalExecutor:
    """Works on each task in the thread that asks for it: the executor of a single process."""

    def __init__(self, threads: int = 1) -> None:
        """Take the number of threads of the run."""
        self.under_way = threads

    def at_once(self, number: int) -> int:
        """Return 1."""
        del number
        return 1

    def share(self, value: ValueT) -> ValueT:
        """Return the value itself."""
        return value

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task."""
        return work(*given)

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results."""
        return work(*given)

    def close(self) -> None:
        """Do nothing."""
