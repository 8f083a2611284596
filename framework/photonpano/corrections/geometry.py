"""The interface of a correction, and those that move pixels: each applies one function to an array of the pixels' numbers.

And how fast the image moves, by which corrections that look at the frames choose how long to sum.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from photonpano.capture import MISSING, Capture, Index, MaskedSpan, numbered
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.errors import InputError
from photonpano.geometry import steps_px
from photonpano.plugins.contributions import Config
from photonpano.values import BoolArray, FluxImage, FrameSpan, Still

Decide: TypeAlias = Callable[[str, float, str], None]  # records a decision: what was chosen, its value, and the reason


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Pixels:
    """The pixels of a frame after some corrections; every array is (H, W)."""

    index: Index  # intp, the number of each pixel in the frame as it is read, counted along its rows; -1 where there is none
    valid: BoolArray  # False for pixels that must not be used
    interpolated: BoolArray  # True for pixels that are replaced by their neighbours
    dark_rates: FluxImage  # float32, dark counts per frame to subtract: photons of binary frames, grey values of others
    # int8, the place in `COLOURS` of the colour that each pixel sees; -1 where all pixels are treated alike
    colour: NDArray[np.int8]
    masks: tuple[MaskedSpan, ...] = ()  # more pixels that must not be used, each in some frames
    still: Still = field(default_factory=Still)  # what stands still in the frame

    @classmethod
    def as_read(cls, capture: Capture) -> Pixels:
        """Return the pixels of a source without corrections."""
        shape, valid = capture.valid.shape, capture.valid
        nothing, dark, colour = np.zeros(shape, np.bool_), np.zeros(shape, np.float32), np.full(shape, -1, np.int8)
        return cls(
            index=numbered(shape), valid=valid, interpolated=nothing, dark_rates=dark, colour=colour, masks=capture.masks
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = self.index.shape
        return height, width

    def rearranged(self, order: Index) -> Pixels:
        """Return the pixels in another order, given as their numbers (see `numbered`), or -1."""
        missing = order == MISSING
        return Pixels(
            index=np.where(missing, MISSING, self.index.ravel()[order]),
            valid=self.valid.ravel()[order] & ~missing,
            interpolated=self.interpolated.ravel()[order] & ~missing,
            dark_rates=np.where(missing, np.float32(0), self.dark_rates.ravel()[order]),
            colour=np.where(missing, np.int8(-1), self.colour.ravel()[order]),
            masks=tuple(MaskedSpan(each.span, each.valid.ravel()[order]) for each in self.masks),
            still=self.still,
        )

    def alike(self) -> list[BoolArray]:
        """Return masks of the pixels that may be compared with each other, since they see one colour: (H, W) each."""
        return [self.colour == each for each in np.unique(self.colour)]

    def without(self, bad: BoolArray, span: FrameSpan | None = None) -> Pixels:
        """Return the pixels with more of them masked, in all frames or in those of a span of the source."""
        if span is not None:
            return replace(self, masks=(*self.masks, MaskedSpan(span, ~bad)))
        return replace(self, valid=self.valid & ~bad)

    def require_some(self, name: str) -> None:
        """Raise an `InputError` if no pixel is left in all frames, or in some, after the correction of this name."""
        if not self.valid.any():
            raise InputError(f"{name} leaves no pixel that may be used")
        for start in (mask.span.start for mask in self.masks):
            masks = [each for each in self.masks if each.span.start <= start < each.span.stop]
            if not np.logical_and.reduce([self.valid, *(each.valid for each in masks)]).any():
                span = FrameSpan(start, min(each.span.stop for each in masks))
                raise InputError(f"{name} leaves no pixel that may be used in {span}; mask less of them, or read other frames")

    def require(self, shape: tuple[int, ...], what: object) -> None:
        """Raise an `InputError` for a file whose size differs from that of frames after the corrections so far."""
        if shape != self.shape:
            given = "x".join(map(str, shape)) + " px" if len(shape) == 2 and all(shape) else f"the shape {shape}"
            here = "x".join(map(str, self.shape))
            raise InputError(f"{what} has {given}, and frames have {here} px at this place of the list")


class Correction(Config, ABC):
    """One correction of a list: its settings, and what it does."""

    name: ClassVar[str]  # its name in specs

    @property
    def changes_sums(self) -> bool:
        """Whether it subtracts something from sums of frames, rather than moving or masking pixels."""
        return False

    @abstractmethod
    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Apply the correction to the pixels that the corrections before it have left.

        `capture` is as it is read. `decide` records what was chosen because of the capture or a file; with None, no frame may
        be read yet, and the correction leaves out what depends on frames.

        Raises:
            InputError: the correction does not suit the pixels, or a file holds something else.
        """


class Rearrangement(Correction):
    """Moves, removes or inserts pixels."""

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Move the pixels; see `Correction`."""
        del capture, decide
        return pixels.rearranged(self.moved(numbered(pixels.shape)))

    @abstractmethod
    def moved(self, pixels: Index) -> Index:
        """Move the numbers of pixels, (H, W), -1 for one that the sensor lacks; `InputError` if the frame is too small."""


class Crop(Rearrangement):
    """Keeps a part of the frame."""

    name: ClassVar[str] = "crop"
    rows: tuple[int | None, int | None] = Field(
        (None, None),
        description="the first row, and the one after the last; negative numbers count from the end, null is the end",
    )
    columns: tuple[int | None, int | None] = Field((None, None), description="the same for columns")

    def moved(self, pixels: Index) -> Index:
        """See `Rearrangement`."""
        return pixels[_part(self.rows, pixels.shape[0], "rows"), _part(self.columns, pixels.shape[1], "columns")]


class SwapColumns(Rearrangement):
    """Swaps two blocks of columns."""

    name: ClassVar[str] = "swap-columns"
    first: tuple[int, int] = Field(description="the first column, and the one after the last, from 0")
    second: tuple[int, int] = Field(description="the columns to swap them with: the same number, without overlap")

    @field_validator("first", "second")
    @classmethod
    def _in_order(cls, columns: tuple[int, int]) -> tuple[int, int]:
        if not 0 <= columns[0] < columns[1]:
            raise ValueError(f"columns count from 0, and the last lies behind the first; got {list(columns)}")
        return columns

    @model_validator(mode="after")
    def _equal(self) -> SwapColumns:
        (start, stop), (other_start, other_stop) = sorted((self.first, self.second))
        if stop - start != other_stop - other_start:
            counts = f"{self.first[1] - self.first[0]} columns {list(self.first)} with the "
            counts += f"{self.second[1] - self.second[0]} columns {list(self.second)}"
            raise ValueError(f"cannot swap the {counts}: the blocks differ in width")
        if other_start < stop:
            raise ValueError(f"cannot swap the columns {list(self.first)} with {list(self.second)}: they overlap")
        return self

    def moved(self, pixels: Index) -> Index:
        """See `Rearrangement`."""
        first, second = (slice(*columns) for columns in (self.first, self.second))
        last = max(self.first[1], self.second[1])
        if last > pixels.shape[1]:
            raise InputError(f"there is no column {last - 1}: frames have {pixels.shape[1]} columns at this place of the list")
        swapped = pixels.copy()
        swapped[:, first], swapped[:, second] = pixels[:, second], pixels[:, first]
        return swapped


class MissingRow(Rearrangement):
    """Inserts a row that the sensor does not have. It is masked, and the motion fills it."""

    name: ClassVar[str] = "missing-row"
    before: int | None = Field(
        None,
        ge=0,
        description="the row before which it is inserted, from 0; by default between the halves of the frame",
    )

    def moved(self, pixels: Index) -> Index:
        """See `Rearrangement`."""
        height = len(pixels)
        before = height // 2 if self.before is None else self.before
        if before > height:
            raise InputError(f"there is no row {before}: frames have {height} rows at this place of the list")
        return np.insert(pixels, before, MISSING, axis=0)


class Turn(Rearrangement):
    """Rotates or mirrors the frame."""

    turn: ClassVar[Callable[[Index], Index]]  # the numpy function that does it

    def moved(self, pixels: Index) -> Index:
        """See `Rearrangement`."""
        return type(self).turn(pixels)


_TURNS: tuple[tuple[str, Callable[[Index], Index], str], ...] = (
    ("rot90", partial(np.rot90, k=-1), "Turns the frame by 90 degrees clockwise."),
    ("rot180", partial(np.rot90, k=2), "Turns the frame upside down, by 180 degrees."),
    ("rot270", partial(np.rot90, k=1), "Turns the frame by 270 degrees clockwise, which is 90 degrees counter-clockwise."),
    ("flip-ud", np.flipud, "Mirrors the frame top to bottom."),
    ("flip-lr", np.fliplr, "Mirrors the frame left to right."),
)
# A class for each way to turn a frame.
TURNS: tuple[type[Turn], ...] = tuple(
    type(name, (Turn,), {"name": name, "turn": staticmethod(turn), "__doc__": doc}) for name, turn, doc in _TURNS
)


class Preset(Rearrangement):
    """Other corrections, one after the other, that a known sensor needs."""

    shape: ClassVar[tuple[int, int]]  # (height, width) of the frames that it is made for
    steps: ClassVar[tuple[Rearrangement, ...]]

    def moved(self, pixels: Index) -> Index:
        """See `Rearrangement`."""
        if pixels.shape != self.shape:
            wanted, here = ("x".join(map(str, shape)) for shape in (self.shape, pixels.shape))
            raise InputError(f"{self.name} is for frames of {wanted} px, and frames have {here} px at this place of the list")
        for step in self.steps:
            pixels = step.moved(pixels)
        return pixels


class ColourSwissSpad2(Preset):
    """A half array of the colour SwissSPAD2: from 256x512 to 254x496 px, with eight columns in their right places."""

    name: ClassVar[str] = "colour-swissspad2"
    shape: ClassVar[tuple[int, int]] = (256, 512)
    steps: ClassVar[tuple[Rearrangement, ...]] = (
        Crop(rows=(2, None), columns=(None, 496)),
        SwapColumns(first=(252, 256), second=(260, 264)),
    )


class GreySwissSpad2Half(Preset):
    """A half array of the grey SwissSPAD2: from 256x512 to 254x496 px."""

    name: ClassVar[str] = "grey-swissspad2-half"
    shape: ClassVar[tuple[int, int]] = (256, 512)
    steps: ClassVar[tuple[Rearrangement, ...]] = (Crop(rows=(2, None), columns=(None, 496)),)


class GreySwissSpad2Full(Preset):
    """The full array of the grey SwissSPAD2: from 512x512 to 509x496 px, with a row for the gap between its halves."""

    name: ClassVar[str] = "grey-swissspad2-full"
    shape: ClassVar[tuple[int, int]] = (512, 512)
    steps: ClassVar[tuple[Rearrangement, ...]] = (MissingRow(), Crop(rows=(2, -2), columns=(None, 496)))


def _part(ends: tuple[int | None, int | None], length: int, what: str) -> slice:
    """Return the slice between two ends; numpy would silently cut off what lies outside the frame."""
    start, stop = (default if end is None else end + length * (end < 0) for end, default in zip(ends, (0, length), strict=True))
    if not 0 <= start < stop <= length:
        given = ", ".join("null" if end is None else str(end) for end in ends)
        raise InputError(f"there are no {what} [{given}]: frames have {length} {what} at this place of the list")
    return slice(start, stop)


def speed_px(source: Source, trajectory: Trajectory) -> float:
    """Return the usual speed of the image, in px per frame."""
    instants = np.linspace(0, source.info.n_frames - 1, 65)
    moved = steps_px(trajectory.at(instants), source.info.frame_shape).max(axis=-1)
    return float(np.median(moved)) / max(float(instants[1]), 1e-9)
