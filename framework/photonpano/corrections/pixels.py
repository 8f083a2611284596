"""The pixels of a frame after some corrections, and the interface of a correction."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import MISSING, Capture, Index, MaskedSpan, numbered
from photonpano.errors import InputError
from photonpano.plugins.contributions import Config
from photonpano.values import BoolArray, FluxImage, FrameSpan, Still

Decide: TypeAlias = Callable[[str, float, str], None]  # records a decision: what was chosen, its value, and the reason


@dataclass(frozen=True, slots=True, eq=False)
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
        return cls(numbered(shape), valid, nothing, dark, colour, capture.masks)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = self.index.shape
        return height, width

    def rearranged(self, order: Index) -> Pixels:
        """Return the pixels in another order, given as their numbers (see `numbered`), or -1."""
        missing = order == MISSING
        return Pixels(
            np.where(missing, MISSING, self.index.ravel()[order]),
            self.valid.ravel()[order] & ~missing,
            self.interpolated.ravel()[order] & ~missing,
            np.where(missing, np.float32(0), self.dark_rates.ravel()[order]),
            np.where(missing, np.int8(-1), self.colour.ravel()[order]),
            tuple(MaskedSpan(each.span, each.valid.ravel()[order]) for each in self.masks),
            self.still,
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
