"""What a list of corrections makes of the pixels of a frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano.contributions import Config
from photonpano.errors import InputError
from photonpano.protocols import Source
from photonpano.values import BoolArray, FluxImage

Index: TypeAlias = NDArray[np.intp]
Decide: TypeAlias = Callable[[str, int, str], None]
"""Is told what was chosen, its value, and the reason."""
MISSING = -1
"""Stands in an index for a pixel that the sensor does not have."""


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """The pixels of a frame after some corrections; every array is (H, W).

    Attributes:
        index: intp, where each lies in the frame as it is read, counted along its rows; -1 where there is none.
        valid: whether it may be used.
        interpolated: whether its neighbours stand in for it.
        dark_rates: float32, dark counts per frame that are to be taken out: photons of binary frames, else grey values.
    """

    index: Index
    valid: BoolArray
    interpolated: BoolArray
    dark_rates: FluxImage

    @classmethod
    def as_read(cls, valid: BoolArray) -> Pixels:
        """Return the pixels of a source without corrections, of which `valid` may be used."""
        nothing = np.zeros(valid.shape, np.bool_)
        return cls(numbered(valid.shape), valid, nothing, np.zeros(valid.shape, np.float32))

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        height, width = self.index.shape
        return height, width

    def rearranged(self, order: Index) -> Pixels:
        """Return them in another order: the numbers of pixels, see `numbered`, where they are to lie, or -1."""
        missing = order == MISSING
        return Pixels(
            np.where(missing, MISSING, self.index.ravel()[order]),
            self.valid.ravel()[order] & ~missing,
            self.interpolated.ravel()[order] & ~missing,
            np.where(missing, np.float32(0), self.dark_rates.ravel()[order]),
        )

    def without(self, bad: BoolArray) -> Pixels:
        """Return them with some more that must not be used."""
        return replace(self, valid=self.valid & ~bad)

    def require(self, shape: tuple[int, ...], what: object) -> None:
        """Refuse what is not of the size that frames have after the corrections so far.

        Raises:
            InputError: says both sizes.
        """
        if shape != self.shape:
            given, here = ("x".join(map(str, size)) for size in (shape, self.shape))
            raise InputError(f"{what} is of {given} px, and frames are of {here} px at this place of the list")


class Correction(Config, ABC):
    """One correction of a list: its settings, and what it does.

    Attributes:
        name: what specs call it.
    """

    name: ClassVar[str]

    @property
    def changes_sums(self) -> bool:
        """Whether it takes something out of sums of frames, rather than moving or masking pixels."""
        return False

    @abstractmethod
    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """Apply it to what the corrections before it have left.

        Args:
            pixels: the pixels so far.
            source: the capture as it is read.
            decide: is told what was chosen because of what the capture or a file shows; None as long as no frame may be read,
                where what depends on frames is left out.

        Raises:
            InputError: it does not suit the pixels, or a file is not what it should be.
        """


def numbered(shape: tuple[int, ...]) -> Index:
    """Number the pixels of a frame along its rows, from 0: (H, W) intp."""
    return np.arange(np.prod(shape), dtype=np.intp).reshape(shape)
