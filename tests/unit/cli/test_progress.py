from __future__ import annotations

import io

import pytest
from rich.console import Console

from photonpano.cli.progress import Bars, progress_for_stderr
from photonpano.context import Quiet


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stderr", "terminal", "expected"),
    [(io.StringIO(), "xterm", Quiet), (Terminal(), "xterm", Bars), (Terminal(), "dumb", Quiet)],
    ids=["pipe", "terminal", "dumb terminal"],
)
def test_progress_draws_bars_only_on_terminal(
    monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO, terminal: str, expected: type
) -> None:
    monkeypatch.setattr("sys.stderr", stderr)
    monkeypatch.setenv("TERM", terminal)
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert isinstance(progress_for_stderr(), expected)


def test_bar_shows_stage_count_and_rate() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=100, force_terminal=True, color_system=None))
    with bars.stage("level 2: locate [all]", 1200, "exposures") as advance:
        advance(600)
        advance(600)
    *_, last = screen.getvalue().split("level 2: locate [all]")
    assert "1200/1200" in last
    assert "exposures/s" in last


def test_note_is_printed_unchanged() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=20, force_terminal=True, color_system=None, markup=False, highlight=False))
    bars.note("level 1: [bold] " + "a long line " * 5)
    assert screen.getvalue() == "level 1: [bold] " + "a long line " * 5 + "\n"
