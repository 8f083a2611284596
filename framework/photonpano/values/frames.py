"""Frame spans, and groups of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        return f"frames {self.start} to {self.stop - 1}" if len(self) > 1 else f"frame {self.start}"

    def blocks(self, length: int) -> list[FrameSpan]:
        """Return the span in blocks of `length` frames, of which the last may be shorter."""
        return [FrameSpan(start, min(start + length, self.stop)) for start in range(self.start, self.stop, length)]

    @property
    def centre(self) -> float:
        """The mean instant of the span, in frames: `(start + stop - 1) / 2`."""
        return (self.start + self.stop - 1) / 2


def true_spans(flags: BoolArray) -> list[FrameSpan]:
    """Return the runs of frames whose flag, of (T,), is set, in order."""
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
