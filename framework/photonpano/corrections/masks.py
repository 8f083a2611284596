"""Corrections that mask pixels listed in a file: bad ones, and those behind a colour filter."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from photonpano.contributions import SpecPath
from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError
from photonpano.reading import look_first, read_array, read_picture

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from photonpano.corrections.pixels import Decide, Pixels
    from photonpano.protocols import Source
    from photonpano.values import BoolArray

Colour = Literal["clear", "red", "green", "blue"]
COLOURS: dict[Colour, tuple[int, int, int]] = {
    "clear": (255, 255, 255),
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
}
"""Red, green and blue of each colour in a pattern."""


class Mask(Correction):
    """Masks the pixels that a file marks as bad; the motion fills them."""

    name: ClassVar[str] = "mask"
    file: SpecPath = Field(
        description="a bool .npy file, true for bad pixels, or a .png picture in which bad pixels are not black; of "
        "the size of the frames at this place of the list"
    )

    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """Mask the bad pixels; see `Correction`."""
        del source, decide
        bad = _read_mask(self.file)
        pixels.require(bad.shape, self.file)
        return pixels.without(bad)


class ColourFilter(Correction):
    """Keeps the pixels of some colours of a colour filter array, so that the pattern does not show."""

    name: ClassVar[str] = "colour-filter"
    pattern: SpecPath = Field(
        description="the filter array, of the size of the frames at this place of the list: a .png picture, or a .npy "
        "file (height, width, 3) of uint8 in the order red, green, blue; clear pixels are white, the "
        "others pure red, green or blue"
    )
    keep: tuple[Colour, ...] = Field(("clear",), description="the colours whose pixels are used")
    others: Literal["mask", "interpolate"] = Field(
        "mask",
        description="the other pixels: mask masks them, and the motion fills them; interpolate takes the mean of the "
        "kept pixels that touch them",
    )

    @property
    def changes_sums(self) -> bool:
        """See `Correction`."""
        return self.others == "interpolate"

    def applied(self, pixels: Pixels, source: Source, decide: Decide | None) -> Pixels:
        """Mask the pixels of other colours, or mark them to be interpolated; see `Correction`."""
        del source, decide
        pattern = _read_pattern(self.pattern)
        pixels.require(pattern.shape[:2], self.pattern)
        kept, known = (_of_colours(pattern, colours) for colours in (self.keep, COLOURS))
        if not known.all():
            row, column = np.argwhere(~known)[0].tolist()
            raise InputError(
                f"{self.pattern} has the colour {tuple(pattern[row, column].tolist())} at row {row}, column {column}; a "
                "pattern has white for clear pixels, and pure red, green and blue"
            )
        if self.others == "mask":
            return pixels.without(~kept)
        return replace(pixels, interpolated=pixels.interpolated | ~kept)


def _of_colours(pattern: NDArray[np.uint8], colours: Iterable[Colour]) -> BoolArray:
    """Return a mask of the pixels that have one of the colours: (H, W)."""
    found: BoolArray = np.logical_or.reduce([np.all(pattern == COLOURS[colour], axis=-1) for colour in colours])
    return found


def _read_mask(path: Path) -> BoolArray:
    expected = "a mask of bad pixels"
    if _is_picture(path):
        return np.asarray(_read_picture(path, expected).any(axis=-1))
    mask = read_array(path, expected)
    if mask.dtype != np.bool_:
        raise InputError(
            f"{path} holds {mask.dtype} values; a mask is a .npy file of bool, true for pixels that must not be used"
        )
    return mask


def _read_pattern(path: Path) -> NDArray[np.uint8]:
    expected = "the pattern of a colour filter"
    if _is_picture(path):
        return _read_picture(path, expected)
    pattern = read_array(path, expected)
    if pattern.dtype != np.uint8 or pattern.ndim != 3 or pattern.shape[2] != 3:
        found = f"{pattern.dtype} values of shape {pattern.shape}"
        raise InputError(f"{path} holds {found}; a pattern is a .npy file of uint8 (height, width, 3)")
    return pattern


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() == ".png"


def _read_picture(path: Path, expected: str) -> NDArray[np.uint8]:
    """Read a picture: (H, W, 3) uint8, red first."""
    import cv2

    look_first(path, "cv2:imread")
    picture = read_picture(path, f"is not {expected}: it is no picture that can be read", cv2.IMREAD_COLOR)
    return np.ascontiguousarray(picture[..., ::-1], dtype=np.uint8)
