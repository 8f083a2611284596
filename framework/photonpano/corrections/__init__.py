"""Corrections of sensors: what is done to frames, in the order of a list, before anything else sees them."""

from photonpano.corrections.dark import DarkCounts, DarkFrames, measure_dark, read_dark, write_dark
from photonpano.corrections.geometry import (
    ColourSwissSpad2,
    Crop,
    FlipLr,
    FlipUd,
    GreySwissSpad2Full,
    GreySwissSpad2Half,
    MissingRow,
    Rot90,
    Rot180,
    Rot270,
    SwapColumns,
)
from photonpano.corrections.hot_pixels import HotPixels, hot_in_the_dark
from photonpano.corrections.masks import ColourFilter, Mask
from photonpano.corrections.pixels import Correction
from photonpano.corrections.source import CorrectedSource, corrected_source

CORRECTIONS: dict[str, type[Correction]] = {
    correction.name: correction
    for correction in (
        *(ColourSwissSpad2, GreySwissSpad2Half, GreySwissSpad2Full),
        *(Crop, SwapColumns, MissingRow),
        *(Rot90, Rot180, Rot270, FlipUd, FlipLr),
        *(Mask, HotPixels, DarkCounts, ColourFilter),
    )
}
"""All corrections by the names that specs call them."""

__all__ = [
    "CORRECTIONS",
    "CorrectedSource",
    "Correction",
    "DarkCounts",
    "DarkFrames",
    "HotPixels",
    "corrected_source",
    "hot_in_the_dark",
    "measure_dark",
    "read_dark",
    "write_dark",
]
