"""Frame spans, groups, and the properties of a capture that are known without reading its frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from photonpano.errors import InputError

if TYPE_CHECKING:
    from photonpano.values.arrays import BoolArray


@dataclass(frozen=True, slots=True, order=True)
class FrameSpan:
    """Half-open range `[start, stop)` of absolute frame indices in a source. Never empty."""

    start: int
    stop: int

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise ValueError(f"a frame span needs 0 <= start < stop, got [{self.start}, {self.stop})")

    def __len__(self) -> int:
        return self.stop - self.start

    def __str__(self) -> str:
        return f"frames {self.start} to {self.stop - 1}"

    def blocks(self, length: int) -> list[FrameSpan]:
        """Return the span in blocks of `length` frames, of which the last may be shorter."""
        return [FrameSpan(start, min(start + length, self.stop)) for start in range(self.start, self.stop, length)]

    @property
    def centre(self) -> float:
        """The mean instant of the span, in frames: `(start + stop - 1) / 2`."""
        return (self.start + self.stop - 1) / 2


def true_spans(flags: BoolArray) -> list[FrameSpan]:
    """Return the runs of frames whose flag is set, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [FrameSpan(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


@dataclass(frozen=True, slots=True)
class Group:
    """Frames that are merged into one virtual exposure, seen from one instant.

    Attributes:
        span: the frames that are merged.
        reference: the instant that is located, in frames; frame i is the instant i. It may lie between two frames, as the
            centre of an even number of frames does, but not outside the span.
    """

    span: FrameSpan
    reference: float

    def __post_init__(self) -> None:
        if not self.span.start <= self.reference <= self.span.stop - 1:
            raise ValueError(f"the reference {self.reference} lies outside {self.span}")

    def __str__(self) -> str:
        return str(self.span)


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
    """

    n_frames: int
    height: int
    width: int
    frame_rate_hz: float | None
    kind: Literal["binary", "intensity"] = "binary"
    bit_depth: int = 1

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
            raise InputError(f"{span} were requested, but the capture has {self.n_frames} frames (0 to {self.n_frames - 1})")
