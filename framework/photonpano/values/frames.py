"""Frames of a capture: names for arrays, spans and groups, properties of the capture, what hides the background, and light.

Geometry is float64, flux is float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import InputError

FloatArray: TypeAlias = NDArray[np.float64]
"""Any float64 array: coordinates, parameters, covariances."""

Homography: TypeAlias = NDArray[np.float64]
"""(3, 3) float64 with h33 = 1; (N, 3, 3) where stated."""

FluxImage: TypeAlias = NDArray[np.float32]
"""(H, W) float32: photons per pixel per frame, NaN where unknown; (H, W, 3) where stated."""

Counts: TypeAlias = NDArray[np.uint32]
"""(H, W) uint32: sums of frames."""

Frames: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
"""(n, H, W): zeros and ones of a binary capture, grey values or small sums of another."""

BoolArray: TypeAlias = NDArray[np.bool_]


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
    """Frames that are merged into one virtual exposure, seen from one instant."""

    span: FrameSpan  # the frames that are merged
    # the instant that is located, in frames; frame i is the instant i. It may lie between two frames, as the centre of an even
    # number of frames does, but not outside the span
    reference: float

    def __post_init__(self) -> None:
        if not self.span.start <= self.reference <= self.span.stop - 1:
            raise ValueError(f"the reference {self.reference} lies outside {self.span}")

    def __str__(self) -> str:
        return str(self.span)


DecisionValue: TypeAlias = bool | int | float | str
"""Values of decisions that can be recorded."""

Bayer: TypeAlias = Literal["rggb", "bggr", "grbg", "gbrg"]
"""Colours of the filters of a Bayer array: the first two pixels of the first row, and then of the second."""


@dataclass(frozen=True, slots=True)
class StreamInfo:
    """Properties of a capture that are known before any frame is read."""

    n_frames: int  # number of frames
    height: int  # rows of a frame
    width: int  # columns of a frame
    frame_rate_hz: float | None  # frames per second; None if the capture does not give it
    # "binary" if a pixel is 0 or 1, "intensity" if it is a grey value or a sum of binary frames
    kind: Literal["binary", "intensity"] = "binary"
    bit_depth: int = 1  # bits of a pixel
    # colours of the filters before the first two pixels of the first two rows, if these repeat, such as "rggb"; None for a grey
    # sensor, another filter array, or if the capture does not give it
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
        """Raise an `InputError` if a span reaches beyond the capture."""
        if span.stop > self.n_frames:
            were = "was" if len(span) == 1 else "were"
            raise InputError(f"{span} {were} requested, but the capture has {self.n_frames} frames (0 to {self.n_frames - 1})")


@dataclass(frozen=True, slots=True)
class CaptureSummary:
    """Brightness of a capture and speed of its image, measured before any motion is estimated."""

    flux: float  # mean of the sampled frames, photons per pixel per frame
    speed_px: float | None  # upper quantile of the speed of the image, in px per frame; None if it could not be measured
    how: str  # a clause that says how the speed was measured, for the reasons of decisions
    # period of light that flickers, in frames; None in steady light, or before the light is known
    period_frames: float | None = None
    # frames after which an image that returns is farthest from where it was; None if it does not return
    away_frames: float | None = None
    shortened: int = 1  # groups are to be chosen this many times shorter, since exposures of longer ones could not be located


@dataclass(frozen=True, slots=True)
class Decision:
    """A value that the spec leaves open and that was chosen from the capture."""

    what: str  # name of the value, such as "group_size"
    value: DecisionValue  # the chosen number, text or flag
    reason: str  # a clause with the numbers that decided


Journal: TypeAlias = list[Decision]  # decisions in the order in which they were taken


@dataclass(frozen=True, slots=True)
class Still:
    """What stands still in the frame."""

    share: float = 0.0  # share of the frame that stands still, of the parts that show motion or rest; 0 if none moves
    how: str = "not measured"  # what is masked for it, a clause


CELL_PX = 8  # side of the cells of a frame that are told from the background, in px


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """Which cells of the frames show the background, which moves as the camera does; others show what moves by itself."""

    instants: FloatArray  # (S,) in order, in frames, S of 1 or more
    shown: BoolArray  # (S, h, w) bool, the cells, of 8 px a side, that show the background at each instant
    # (S, h, w) bool, these cells, and those that show least of something else at places whose background is never seen: every
    # place is shown by some
    filled: BoolArray
    frame_shape: tuple[int, int]  # (height, width) of a frame

    def cells(self, span: FrameSpan) -> BoolArray:
        """Return the cells that show the background at all instants in a span of frames, and at the ones next to it: (h, w)."""
        first, last = np.searchsorted(self.instants, [span.start, span.stop - 1])
        return np.asarray(self.shown[max(0, first - 1) : last + 1].all(axis=0))

    def pixels(self, span: FrameSpan) -> NDArray[np.uint8] | None:
        """Return the pixels that show the background in a span of frames, as 1, others as 0: (H, W); None if all do."""
        cells = self.cells(span)
        if cells.all():
            return None
        height, width = self.frame_shape
        return cells.view(np.uint8).repeat(CELL_PX, axis=0)[:height].repeat(CELL_PX, axis=1)[:, :width]

    @property
    def hidden_share(self) -> float:
        """The share of the frames that does not show the background."""
        return float((1 - self.shown.mean(axis=(1, 2))).mean())

    def without(self, other: Background) -> Background:
        """Return what both show of the background."""
        nearest = np.abs(self.instants[:, None] - other.instants).argmin(axis=1)
        return replace(self, shown=self.shown & other.shown[nearest])

    def part(self, span: FrameSpan) -> Background:
        """Return that of some frames."""
        return replace(self, instants=self.instants - span.start)


_CLASSES = 8  # most classes into which frames are divided by their gain, or by the phase of the lamps
_CLASS_WIDTH = 0.1  # least range of the gains of a class


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """The light of each frame, relative to its mean.

    The gain of the frame t at a place x of the scene is `gain[t] (1 + sum_k waves[k, t] maps[k](x))`. It is the light there,
    relative to the mean over time.
    """

    gain: FloatArray  # (T,) float64, not negative: of all of the scene
    waves: FloatArray  # (K, T) float64, cosine and sine of the lamps, between -1 and 1; (0, T) if all of the scene has one gain
    maps: FluxImage  # (K, h, w) float32, their amplitude at places of the scene
    # (3, 3), pixels of the reference plane to pixels of `maps`; on a sphere (a, b, 1) to pixels, as that of a canvas
    to_map: Homography
    frequency: float  # flickers in a frame period; 0 for light that does not flicker
    std: FloatArray  # (T,) standard deviation of `gain` by photon noise; infinite for frames that are left out, whose gain is 0
    # (3, 3) of the reference camera around which `maps` lie on a sphere; None if they lie on its plane
    camera_matrix: FloatArray | None = None
    # (C, T) of each colour, in the order of `Capture.colours`: factors of the gain, and their standard deviations; None where
    # all colours have one gain
    tints: FloatArray | None = None
    std_tints: FloatArray | None = None

    @classmethod
    def of_frames(cls, gain: FloatArray, frequency: float = 0.0, std: FloatArray | None = None) -> Light:
        """Return light of (T,) gains that is the same all over the scene; their (T,) standard deviations are 0 by default."""
        nothing = np.zeros_like(gain) if std is None else std
        return cls(gain, np.zeros((0, len(gain))), np.zeros((0, 1, 1), np.float32), np.eye(3), frequency, nothing)

    @property
    def has_lamps(self) -> bool:
        """Whether the gain depends on the place."""
        return len(self.waves) > 0

    @property
    def shown(self) -> BoolArray:
        """(T,) False for frames that are left out, such as those behind a closed shutter."""
        return np.isfinite(self.std)

    def leaving_out(self, shown: BoolArray) -> Light:
        """Return this light without the frames that are not `shown`, (T,), relative to the mean of the others."""
        mean = float(self.gain[shown].mean())
        return replace(self, gain=np.where(shown, self.gain / mean, 0), std=np.where(shown, self.std / mean, np.inf))

    def of_colour(self, index: int) -> Light:
        """Return the light of one colour."""
        if self.tints is None or self.std_tints is None:
            return self
        tint, std_tint = self.tints[index], self.std_tints[index]
        std = np.hypot(self.std * np.maximum(tint, 1e-9), self.gain * std_tint)  # infinite where a frame is left out
        return replace(self, gain=self.gain * tint, std=std, tints=None, std_tints=None)

    def terms(self, span: FrameSpan) -> FloatArray:
        """Return the terms of the gain in each frame of a span: (1 + K, n), the first for all of the scene."""
        frames = slice(span.start, span.stop)
        return np.concatenate([self.gain[None, frames], self.gain[frames] * self.waves[:, frames]])

    def mean(self, span: FrameSpan) -> float:
        """Return the mean over the frames of a span of the gain of all of the scene."""
        return float(self.gain[span.start : span.stop].mean())

    def part(self, span: FrameSpan) -> Light:
        """Return the light of some frames."""
        frames = slice(span.start, span.stop)
        tints, std_tints = (None if each is None else each[:, frames] for each in (self.tints, self.std_tints))
        cut = replace(self, gain=self.gain[frames], waves=self.waves[:, frames], std=self.std[frames])
        return replace(cut, tints=tints, std_tints=std_tints)

    def classes(self) -> NDArray[np.int64]:
        """Return the class of each frame: (T,), from 0. Within a class the gain of each place hardly changes."""
        if self.has_lamps:
            phase = np.arctan2(self.waves[1], self.waves[0]) / (2 * np.pi)
            return np.asarray(np.floor(phase % 1 * _CLASSES), np.int64) % _CLASSES
        low, high = float(self.gain.min()), float(self.gain.max())
        number = int(np.clip(np.ceil((high - low) / _CLASS_WIDTH), 1, _CLASSES))
        return np.asarray(np.clip((self.gain - low) / max(high - low, 1e-12) * number, 0, number - 1), np.int64)
