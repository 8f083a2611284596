"""Summary of a capture, and decisions that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

DecisionValue: TypeAlias = bool | int | float | str
"""Values of decisions that can be recorded."""


@dataclass(frozen=True, slots=True)
class CaptureSummary:
    """Brightness of a capture and speed of its image, measured before any motion is estimated.

    Attributes:
        flux: mean of the sampled frames, photons per pixel per frame.
        speed_px: upper quantile of the speed of the image, in px per frame; None if it could not be measured.
        how: a clause that says how the speed was measured, for the reasons of decisions.
    """

    flux: float
    speed_px: float | None
    how: str


@dataclass(frozen=True, slots=True)
class Decision:
    """A value that the spec leaves open and that was chosen from the capture.

    Attributes:
        what: name of the value, such as "group_size".
        value: the chosen number, text or flag.
        reason: a clause with the numbers that decided.
    """

    what: str
    value: DecisionValue
    reason: str
