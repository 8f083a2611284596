"""What the frames of a capture tell before any motion is known, and what was chosen because of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

DecisionValue: TypeAlias = bool | int | float | str
"""What can be chosen, so that it can be recorded."""


@dataclass(frozen=True, slots=True)
class CaptureSummary:
    """How bright a capture is, and how fast its image moves.

    Attributes:
        flux: mean over pixels and places, photons per pixel per frame.
        speed_px: how fast the image moves where it is fast, in px a frame; None if no place tells.
        how: a clause that says how the speed was measured, for the reasons of choices.
    """

    flux: float
    speed_px: float | None
    how: str


@dataclass(frozen=True, slots=True)
class Decision:
    """Something that a spec leaves open, and that was chosen from what the capture shows.

    Attributes:
        what: its name, such as "group_size".
        value: what was chosen: a number, a text, true or false.
        reason: a clause with the numbers that decided.
    """

    what: str
    value: DecisionValue
    reason: str
