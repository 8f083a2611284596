from __future__ import annotations

import io
import time

import pytest
from rich.console import Console

from photonpano.cli import progress
from photonpano.cli.progress import Bars, Lines, progress_for_stderr


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stderr", "environment", "expected"),
    [
        (io.StringIO(), {"TERM": "xterm"}, Lines),
        (Terminal(), {"TERM": "xterm"}, Bars),
        (Terminal(), {"TERM": "dumb"}, Lines),
        (Terminal(), {"TERM": "xterm", "JPY_PARENT_PID": "1"}, Lines),
    ],
    ids=["pipe", "terminal", "dumb terminal", "cell of a notebook"],
)
def test_progress_draws_bars_only_on_terminal(
    monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO, environment: dict[str, str], expected: type
) -> None:
    monkeypatch.setattr("sys.stderr", stderr)
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    for name, value in {"FORCE_COLOR": "1", **environment}.items():
        monkeypatch.setenv(name, value)
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


def test_line_is_printed_at_each_interval_and_none_for_short_stage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "INTERVAL_S", 0.2)
    monkeypatch.setattr(progress, "_LEAST_S", 0.1)
    lines = Lines()
    for _ in range(3):
        with lines.stage("short", 1, "frames") as advance:
            advance(1)
    with lines.stage("level 2: locate", 1200, "exposures") as advance:
        advance(400)
        time.sleep(0.5)
        advance(800)
    lines.note("level 2: done")
    first, *_, last = capsys.readouterr().err.splitlines()
    for line in (first, last):
        assert line.startswith("level 2: locate: 400 of 1,200 exposures after ")
        assert line.endswith(" left")


def test_progress_survives_closed_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr("sys.stderr", Closed())
    lines = Lines(notes=True, stages=True)
    with lines.stage("level 1", 1, "exposures") as advance:
        advance(1)
    lines.note("level 1: done")
