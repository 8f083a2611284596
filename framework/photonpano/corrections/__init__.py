"""Corrections of sensors: applied to frames in the order of a list, before any other stage."""

from photonpano.corrections.applying import corrected_source
from photonpano.corrections.colour_filter import ColourFilter
from photonpano.corrections.dark import (
    DarkCounts,
    DarkFrames,
    HotPixels,
    Mask,
    hot_in_the_dark,
    measure_dark,
    read_dark,
    write_dark,
)
from photonpano.corrections.flat_field import FlatField, Vignette, divided_by, estimate_vignette, read_vignette, write_vignette
from photonpano.corrections.geometry import (
    TURNS,
    ColourSwissSpad2,
    Correction,
    Crop,
    GreySwissSpad2Full,
    GreySwissSpad2Half,
    MissingRow,
    SwapColumns,
)
from photonpano.corrections.still_pixels import StillPixels, without_still_pixels

_ALL: tuple[type[Correction], ...] = (
    *(ColourSwissSpad2, GreySwissSpad2Half, GreySwissSpad2Full),
    *(Crop, SwapColumns, MissingRow),
    *TURNS,
    *(Mask, HotPixels, StillPixels, DarkCounts, FlatField, ColourFilter),
)
CORRECTIONS = {correction.name: correction for correction in _ALL}  # all corrections by their names in specs

__all__ = [
    "CORRECTIONS",
    "Correction",
    "DarkFrames",
    "FlatField",
    "HotPixels",
    "Mask",
    "Vignette",
    "corrected_source",
    "divided_by",
    "estimate_vignette",
    "hot_in_the_dark",
    "measure_dark",
    "read_dark",
    "read_vignette",
    "without_still_pixels",
    "write_dark",
    "write_vignette",
]
