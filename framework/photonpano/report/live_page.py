"""Render the page of a run that follows a capture while it is written."""

from __future__ import annotations

from dataclasses import dataclass
from time import time_ns
from typing import Literal

from photonpano.report.drawing import filled


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """How far a run is that follows a capture."""

    # finishing: the capture is complete, and the whole of it is run
    state: Literal["waiting", "following", "finishing", "finished", "stopped"] = "waiting"
    frames: int = 0  # frames that have arrived
    promised: int | None = None  # frames that the capture will have; None if it does not say so
    shown: int = 0  # frames in the picture so far
    message: str = ""  # why the frames so far gave no panorama, or why the run has stopped; empty if nothing is wrong


def render_live(figures: LiveFigures, title: str, so_far: str, whole: str) -> str:
    """Return the page, which loads itself anew each second as long as the run goes on.

    `so_far` and `whole` are the addresses of the run folders of the frames so far, and of the whole capture.
    """
    # Another address each time, so that no browser shows an old picture.
    return filled("live.html", figures=figures, title=title, so_far=so_far, whole=whole, now=time_ns())
