"""The interface of executors."""

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
        ...

    def at_once(self, number: int) -> int:
        """Return how many of a number of items are best worked on in one task: more than one where tasks cost time to send."""
        ...

    def share(self, value: ValueT) -> ValueT:
        """Return what stands for a value, which may be large, in tasks: it travels to each worker once."""
        ...

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task, and return its result."""
        ...

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results: the first stays where it was made, and what is returned stands for it in tasks."""
        ...

    def close(self) -> None:
        """Cancel what is under way, and release what was started for the run."""
        ...
