"""Render the page of a run that follows a capture while it is written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from photonpano.report.environment import filled


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """How far a run is that follows a capture; seconds and shares of frames are None before the first frame is located.

    Attributes:
        state: waiting for the first frame, following, finishing (the capture is complete, and the whole of it is run),
            finished, or stopped.
        frames: that have arrived.
        promised: frames that the capture will have; None if it does not say so.
        located: frames that were located as they arrived.
        behind_frames: frames that have arrived and are not located yet.
        behind_s: how long the first of them has waited, in seconds.
        frames_per_s: rate of arrival within the last seconds.
        delay_mean_s: mean time from the arrival of a frame until it was located.
        delay_95_s: 95 % of the frames did not wait longer.
        delay_longest_s: greatest of these times.
        message: why frames could not be located, or why the run has stopped; empty if nothing is wrong.
    """

    state: Literal["waiting", "following", "finishing", "finished", "stopped"] = "waiting"
    frames: int = 0
    promised: int | None = None
    located: int = 0
    behind_frames: int = 0
    behind_s: float = 0.0
    frames_per_s: float = 0.0
    delay_mean_s: float | None = None
    delay_95_s: float | None = None
    delay_longest_s: float | None = None
    message: str = ""


def render_live(figures: LiveFigures, title: str, picture: str | None, report: str) -> str:
    """Return the page, which loads itself anew each second as long as the run goes on.

    `picture` and `report` are addresses; None as long as there is no picture.
    """
    return filled("live.html", figures=figures, title=title, picture=picture, report=report)
