"""Rows of a panorama that is rendered and stored."""

from __future__ import annotations

from dataclasses import dataclass

from photonpano.values.arrays import BoolArray, FluxImage


@dataclass(frozen=True, slots=True, eq=False)
class PanoramaRows:
    """Some rows of a panorama.

    Attributes:
        flux: (h, W), or (h, W, 3) of red, green and blue; float32, photons per pixel per frame, NaN where nothing was seen.
        weight: the same shape, float32, number of frames in which each pixel was seen; 0 where nothing was seen.
        std: the same shape, float32, standard deviation of the flux; NaN where nothing was seen.
        saturated: the same shape, bool, pixels that were lit in every frame, whose flux is a lower bound.
    """

    flux: FluxImage
    weight: FluxImage
    std: FluxImage
    saturated: BoolArray
