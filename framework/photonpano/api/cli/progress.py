"""Show the progress of a command, bars on a terminal and a line every ten seconds elsewhere."""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from photonpano.api.cli.verbosity import is_logged, is_quiet, is_verbose, log_shown
from photonpano.execution.context import Progress, Quiet
from photonpano.text import count, duration

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console
    from rich.progress import Progress as RichProgress

INTERVAL_S = 10.0  # time between two lines of progress
_LEAST_S = 1.0  # minimum age of a stage that is printed
_TOLD_FROM = 0.05  # share of a stage that is done before the time left is told
_IN_NOTEBOOK = "JPY_PARENT_PID"  # set in notebooks, whose terminal prints control characters


def progress_for_stderr(*, notes: bool = False) -> Progress:
    """Return bars for a terminal, nothing with `-q`, and lines elsewhere, which show notes only on request."""
    shown = _progress_for_stderr(notes or is_verbose())
    return Logged(shown) if is_logged() else shown


def _progress_for_stderr(notes: bool) -> Progress:
    if is_quiet():
        return Quiet()
    if sys.stderr.isatty() and _IN_NOTEBOOK not in os.environ:
        from rich.console import Console

        console = Console(stderr=True, highlight=False, markup=False, emoji=False)
        if not console.is_dumb_terminal:
            return Bars(console)
    return Lines(notes=notes, stages=is_verbose())


class Bars:
    """Draws a bar for each stage; finished bars stay, with the time they took."""

    def __init__(self, console: Console) -> None:
        self._console = console

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Draw the bar of a stage of `total` units."""
        with _bar(self._console, unit) as bar:
            task = bar.add_task(title, total=total)

            def advance(done: int) -> None:
                bar.advance(task, done)
                if bar.finished:  # what is left to do with the units has no bar
                    bar.update(task, description=f"{title}, to be finished")

            yield advance
            bar.update(task, description=title)

    def note(self, message: str) -> None:
        """Print a line."""
        self._console.print(message, soft_wrap=True)


class Lines:
    """Prints a line every `INTERVAL_S` with progress and the time left; on request also notes, and stages when done."""

    def __init__(self, *, notes: bool = False, stages: bool = False) -> None:
        self._notes, self._stages = notes, stages
        self._due = time.monotonic() + INTERVAL_S

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Print lines while the stage goes on, and after it."""
        state = _Stage(title, total, unit)
        self._due = max(self._due, time.monotonic() + _LEAST_S)
        over = threading.Event()
        # A thread, so that a single unit that takes minutes has its lines as well.
        printing = threading.Thread(target=self._print, args=(state, over), name="progress", daemon=True)
        printing.start()
        try:
            yield state.advance
        finally:
            over.set()
            printing.join()
        if self._stages:
            _print(state.finished())

    def note(self, message: str) -> None:
        """Print a line."""
        if self._notes:
            _print(message)

    def _print(self, state: _Stage, over: threading.Event) -> None:
        while not over.wait(max(0.0, self._due - time.monotonic())):
            self._due = time.monotonic() + INTERVAL_S
            _print(str(state))


class Logged:
    """Writes stages and notes to the log, and shows them."""

    def __init__(self, shown: Progress) -> None:
        self._shown = shown

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        """Write when the stage begins, and when it is done."""
        state = _Stage(title, total, unit)
        log_shown(logging.INFO, f"{title}: begins")
        with self._shown.stage(title, total, unit) as advance:
            yield advance
        log_shown(logging.INFO, state.finished())

    def note(self, message: str) -> None:
        """Write a line."""
        log_shown(logging.INFO, message)
        self._shown.note(message)


class _Stage:
    """How far a stage is."""

    def __init__(self, title: str, total: int, unit: str) -> None:
        self._title, self._total, self._unit = title, total, unit
        self._done, self._lock, self._start = 0, threading.Lock(), time.monotonic()

    def advance(self, done: int) -> None:
        """Count units that are done."""
        with self._lock:
            self._done += done

    def __str__(self) -> str:
        done, seconds = self._done, time.monotonic() - self._start
        # The first units take longer than the others: loops are compiled.
        is_known = _TOLD_FROM * self._total <= done < self._total
        left = f", about {duration(seconds * (self._total - done) / done)} left" if is_known else ""
        left = ", to be finished" if done >= self._total else left
        return f"{self._title}: {count(done)} of {count(self._total)} {self._unit} after {duration(seconds)}{left}"

    def finished(self) -> str:
        """Return what was done, and how long it took."""
        return f"{self._title}: {count(self._total)} {self._unit} in {duration(time.monotonic() - self._start)}"


def _print(line: str) -> None:
    with suppress(OSError):  # nobody reads standard error: no reason to end a run
        sys.stderr.write(f"{line}\n")
        sys.stderr.flush()


def _bar(console: Console, unit: str) -> RichProgress:
    from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, Task, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress
    from rich.text import Text

    class Rate(ProgressColumn):
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
