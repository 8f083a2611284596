"""Flux images with weights: virtual exposures and panoramas; and the camera response."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photonpano.notebooks import facts, picture
from photonpano.text import share
from photonpano.values.frames import BoolArray, FluxImage, Group, Homography


class Response(Protocol):
    """Camera response: flux to counts, and back. Every method works element by element and keeps NaN.

    Flux is photons per pixel per frame; a mean count is the sum of some frames divided by their number.
    """

    def mean_count(self, flux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the expected count of one frame at this flux."""

    def flux(self, mean_count: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return the maximum-likelihood flux of a mean count over `frames` frames; finite for finite input."""

    def stabilised(self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Map flux estimated from `frames` frames to a scale on which its noise is uniform: see `stabilised_std`.

        The mean does not depend on the number of frames, so that exposures of different lengths are comparable.
        """

    def stabilised_std(self, frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return the standard deviation, on that scale, of flux estimated from `frames` frames."""


@dataclass(frozen=True, slots=True, eq=False)
class VirtualExposure:
    """Flux and weight merged from a group, seen from its reference instant.

    Convention:
        The grid is that of a frame, rescaled: pixel centres p of the frame lie at `(p + 0.5) * scale - 0.5`.
    """

    flux: FluxImage  # (H, W) float32, photons per pixel per frame, NaN where nothing was seen
    weight: FluxImage  # (H, W) float32, number of frames in which each pixel was seen; 0 exactly where flux is NaN
    group: Group  # the frames and the instant
    scale: float  # pixels of the exposure per pixel of a frame
    response: Response  # the camera's response, from which the noise of the flux follows


@dataclass(frozen=True, slots=True, eq=False)
class Panorama:
    """Flux and weight on a canvas."""

    # (H, W) float32, photons per pixel per frame, NaN where nothing was seen; (H, W, 3) of red, green and blue pixels for a
    # capture in colour
    flux: FluxImage
    # number of frames in which each pixel was seen (the coverage), float32 of the same shape; 0 in a colour that was filled
    # from the others
    weight: FluxImage
    canvas: Homography  # (3, 3) float64, pixels of the reference plane to pixels of the panorama

    def _repr_html_(self) -> str:
        """Show the flux in a notebook."""
        height, width = self.flux.shape[:2]
        seen = np.isfinite(self.flux)
        rows = [("panorama", f"{height}x{width} px" + (", in colour" if self.flux.ndim == 3 else ""))]
        rows.append(("seen", share(float(seen.mean()))))
        if seen.any():
            rows += [
                ("flux, median", f"{np.median(self.flux[seen]):.3g} photons per pixel per frame"),
                ("weight, median", f"{np.median(self.weight[seen]):,.0f} frames"),
            ]
        return picture(self.flux, "the panorama") + facts(rows)


@dataclass(frozen=True, slots=True, eq=False)
class PanoramaRows:
    """Some rows of a panorama."""

    # (h, W), or (h, W, 3) of red, green and blue; float32, photons per pixel per frame, NaN where nothing was seen
    flux: FluxImage
    weight: FluxImage  # the same shape, float32, number of frames in which each pixel was seen; 0 where nothing was seen
    std: FluxImage  # the same shape, float32, standard deviation of the flux; NaN where nothing was seen
    saturated: BoolArray  # the same shape, bool, pixels that were lit in every frame, whose flux is a lower bound
