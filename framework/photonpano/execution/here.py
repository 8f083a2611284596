"""The executor of a single process: tasks are worked on by the threads that ask for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

ValueT = TypeVar("ValueT")
ResultT = TypeVar("ResultT")


class Here:
    """Works on each task in the thread that calls; see `Executor`."""

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
