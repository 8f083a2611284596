from __future__ import annotations

import io

from rich.console import Console

from photonpano.cli.progress import Bars, progress_for_stderr
from photonpano.pipeline.progress import Quiet


def test_quiet_where_nobody_watches() -> None:
    assert isinstance(progress_for_stderr(), Quiet)


def test_a_bar_shows_stage_count_and_rate() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=100, force_terminal=True, color_system=None))
    with bars.stage("level 2: locate [all]", 1200, "exposures") as advance:
        advance(600)
        advance(600)
    *_, last = screen.getvalue().split("level 2: locate [all]")
    assert "1200/1200" in last
    assert "exposures/s" in last


def test_notes_are_printed_as_they_are() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=20, force_terminal=True, color_system=None, markup=False, highlight=False))
    bars.note("level 1: [bold] " + "a long line " * 5)
    assert screen.getvalue() == "level 1: [bold] " + "a long line " * 5 + "\n"
