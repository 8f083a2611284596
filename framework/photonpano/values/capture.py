"""Properties of a capture, its summary, and the decisions that follow from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from photonpano.errors import InputError
from photonpano.values.frames import FrameSpan

DecisionValue: TypeAlias = bool | int | float | str
"""Values of decisions that can be recorded."""

Bayer: TypeAlias = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colours of the filters of a Bayer array: the first two pixels of the first row, and then of the second."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Properties of a capture that are known before any frame is read.

    Attributes:
        n_frames: number of frames.
        height: rows of a frame.
        width: columns of a frame.
        frame_rate_hz: frames per second; None if the capture does not give it.
        kind: "binary" if a pixel is 0 or 1, "intensity" if it is a grey value or a sum of binary frames.
        bit_depth: bits of a pixel.
        bayer: colours of the filters before the first two pixels of the first two rows, if these repeat, such as "rggb"; None
            for a grey sensor, another filter array, or if the capture does not give it.
    """

    n_frames: int
    height: int
    width: int
    frame_rate_hz: float | None
    kind: Literal["binary", "intensity"] = "binary"
    bit_depth: int = 1
    bayer: Bayer | None = None

    def __str__(self) -> str:
        kind = "binary" if self.kind == "binary" else f"{self.bit_depth}-bit"
        rate = "" if self.frame_rate_hz is None else f" at {self.frame_rate_hz:,.15g} Hz"
        return f"{self.n_frames:,} {kind} frames of {self.height}x{self.width}{rate}"

    @property
    def frame_shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.height, self.width

    @property
    def span(self) -> FrameSpan:
        """All frames."""
        return FrameSpan(0, self.n_frames)

    def spread(self, places: int, frames: int) -> list[FrameSpan]:
        """Return `places` evenly spaced spans of `frames` frames; the whole capture in one span if it is shorter than that."""
        if self.n_frames <= places * frames:
            return [self.span]
        starts = np.linspace(0, self.n_frames - frames, places).astype(int).tolist()
        return [FrameSpan(start, start + frames) for start in starts]

    def require(self, span: FrameSpan) -> None:
        """Raise if a span reaches beyond the capture.

        Raises:
            InputError: the span reaches beyond the last frame.
        """
        if span.stop > self.n_frames:
            were = "was" if len(span) == 1 else "were"
            raise InputError(f"{span} {were} requested, but the capture has {self.n_frames} frames (0 to {self.n_frames - 1})")


@dataclass(frozen=True, slots=True)
class CaptureSummary:
    """Brightness of a capture and speed of its image, measured before any motion is estimated.

    Attributes:
        flux: mean of the sampled frames, photons per pixel per frame.
        speed_px: upper quantile of the speed of the image, in px per frame; None if it could not be measured.
        how: a clause that says how the speed was measured, for the reasons of decisions.
        period_frames: period of light that flickers, in frames; None in steady light, or before the light is known.
        shortened: groups are to be chosen this many times shorter, since exposures of longer ones could not be located.
    """

    flux: float
    speed_px: float | None
    how: str
    period_frames: float | None = None
    shortened: int = 1


@dataclass(frozen=True, slots=True)
class Decision:
    """A value that the spec leaves open and that was chosen from the capture."""

    what: str  # name of the value, such as "group_size"
    value: DecisionValue  # the chosen number, text or flag
    reason: str  # a clause with the numbers that decided
