"""Read the pattern of a colour filter array: keep the pixels of some colours, or each colour by itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from photonpano.contributions import SpecPath
from photonpano.corrections.pixels import Correction
from photonpano.errors import InputError
from photonpano.reading import COLOURS, bayer_array, read_filter_array
from photonpano.text import listed
from photonpano.values import Bayer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.capture import Capture
    from photonpano.corrections.pixels import Decide, Pixels

Colour = Literal["red", "green", "blue", "clear"]
_ALL = "all"


class ColourFilter(Correction):
    """Makes the panorama in colour, or keeps the pixels of some colours, so that the pattern of the filters does not show."""

    name: ClassVar[str] = "colour-filter"
    pattern: Bayer | SpecPath | None = Field(
        None,
        description="the filter array, at this place of the list: rggb, bggr, grbg or gbrg for the two rows and columns of "
        "a Bayer array that repeat; or a file of the size of the frames, which is a .png picture, or a .npy file "
        "(height, width, 3) of uint8 in the order red, green, blue, where clear pixels are white, the others pure red, "
        "green or blue; by default the Bayer array that the capture gives",
    )
    keep: Literal["all"] | tuple[Colour, ...] = Field(
        ("clear",),
        description="the colours whose pixels are used; all makes the panorama in colour, and estimates the motion from all "
        "pixels",
    )
    others: Literal["mask", "interpolate"] = Field(
        "mask",
        description="the pixels of other colours: mask masks them, and the motion fills them; interpolate takes the mean of "
        "the kept pixels that touch them",
    )

    @model_validator(mode="after")
    def _some_others(self) -> ColourFilter:
        if self.keep == _ALL and self.others == "interpolate":
            raise ValueError("keep: all leaves no other colours to interpolate; leave out others, or list the colours to keep")
        return self

    @property
    def changes_sums(self) -> bool:
        """See `Correction`."""
        return self.others == "interpolate"

    @property
    def in_colour(self) -> bool:
        """Whether the panorama is in colour."""
        return self.keep == _ALL

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mark the colour of each pixel, or mask or interpolate those of other colours; see `Correction`."""
        del decide
        colour, what = self._pattern(pixels, capture)
        there = [name for place, name in enumerate(COLOURS) if (colour == place).any()]
        wanted = ("red", "green", "blue") if self.keep == _ALL else self.keep
        lacking = [name for name in wanted if name not in there]
        if lacking and (self.in_colour or len(lacking) == len(wanted)):
            keep = _ALL if self.keep == _ALL else f"[{', '.join(self.keep)}]"
            raise InputError(
                f"keep: {keep} needs {listed(lacking)} pixels, and {what} has {listed(there)} ones only; "
                f"keep: [{', '.join(there)}] makes a grey panorama of them"
            )
        if self.in_colour:
            return replace(pixels, colour=colour)
        kept = np.isin(colour, [place for place, name in enumerate(COLOURS) if name in wanted])
        if self.others == "mask":
            return pixels.without(~kept)
        return replace(pixels, interpolated=pixels.interpolated | ~kept)

    def _pattern(self, pixels: Pixels, capture: Capture) -> tuple[NDArray[np.int8], str]:
        """Return the place in `COLOURS` of the colour of each pixel, (H, W), and what to call the pattern in messages."""
        if isinstance(self.pattern, Path):
            pattern = read_filter_array(self.pattern)
            pixels.require(pattern.shape, f"pattern: {self.pattern}")
            return pattern, f"{self.pattern}"
        if self.pattern is not None:
            return bayer_array(self.pattern, pixels.shape), f"pattern: {self.pattern}"
        if capture.info.bayer is None:
            raise InputError(
                f"pattern is missing, and the capture does not give it; set it to a file, or to {', '.join(get_args(Bayer))}"
            )
        as_read = bayer_array(capture.info.bayer, capture.info.frame_shape)
        return as_read.ravel()[pixels.index], f"the array of the capture, {capture.info.bayer},"
