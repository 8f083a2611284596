"""Draw the progress of a command: a bar for each stage, with its rate and the time left."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from photonpano.context import Progress, Quiet

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console
    from rich.progress import Progress as RichProgress


def progress_for_stderr() -> Progress:
    """Return bars for a terminal; pipes, files and continuous integration stay quiet."""
    from rich.console import Console

    console = Console(stderr=True, highlight=False, markup=False, emoji=False)
    return Bars(console) if sys.stderr.isatty() and not console.is_dumb_terminal else Quiet()


class Bars:
    """Draws a bar for each stage; finished bars stay, with the time they took."""

    def __init__(self, console: Console) -> None:
        self._console = console

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Draw the bar of a stage of `total` units."""
        with _bar(self._console, unit) as bar:
            task = bar.add_task(title, total=total)
            yield lambda done: bar.advance(task, done)

    def note(self, message: str) -> None:
        """Print a line."""
        self._console.print(message, soft_wrap=True)


def _bar(console: Console, unit: str) -> RichProgress:
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress
    from rich.text import Text

    class Rate(ProgressColumn):
        """Units per second."""

        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text(f"{speed:,.0f} {unit}/s" if speed and speed >= 10 else f"{speed or 0:.1f} {unit}/s")

    return RichProgress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
        console=console,
    )
