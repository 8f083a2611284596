"""Light that changes: measured from what a capture shows along its motion, and attached to its source."""

from photonpano.capture import in_light
from photonpano.corrections.lighting.finding import (
    corrected_light,
    decision_of,
    find_light,
    in_light_of,
    measure_light,
    write_light,
)
from photonpano.corrections.lighting.flat_field import PixelGain, measure_pixel_gain

__all__ = [
    "PixelGain",
    "corrected_light",
    "decision_of",
    "find_light",
    "in_light",
    "in_light_of",
    "measure_light",
    "measure_pixel_gain",
    "write_light",
]
