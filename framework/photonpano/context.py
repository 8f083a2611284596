"""How a long computation runs: number of threads, progress and callbacks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol


class Progress(Protocol):
    """Shows stages as they advance, and messages. Stages do not overlap; calls may come from any thread."""

    def stage(self, title: str, total: int, unit: str) -> AbstractContextManager[Callable[[int], None]]:
        """Enter a stage of `total` units, such as "level 2: locate" of 81 exposures; call the value with units done."""
        ...

    def note(self, message: str) -> None:
        """Show one line, such as the result of a level or a warning."""
        ...


class Quiet:
    """Progress that shows nothing."""

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Ignore a stage."""
        del title, total, unit
        yield lambda _: None

    def note(self, message: str) -> None:
        """Ignore a line."""


@dataclass(frozen=True, slots=True)
class Context:
    """How a computation runs; its result does not depend on it.

    Attributes:
        threads: how many threads work at once.
        progress: receives stages and messages.
        on_level: called with the `LevelResult` of each level of the loop when it is done.
    """

    threads: int = 1
    progress: Progress = field(default_factory=Quiet)
    on_level: Callable[[Any], object] = lambda _: None
