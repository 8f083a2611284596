"""The noise of estimated flux: its standard deviation, saturated pixels, and the range of flux above the noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry.responses import Factor

if TYPE_CHECKING:
    from photonpano.values import BoolArray, FluxImage, Response

_STEP = 0.01  # relative step of numerical derivatives
_NEARLY = 0.9  # counts, over all frames, that a saturated pixel may lack: one dark binary frame is one
_ROUNDING = 1e-6  # relative rounding error of a mean count
_MANY_FRAMES = 1e12
_EXACT_FRAMES = 1e4  # for which the variance of a frame is derived, where stabilised scales hold
_FLUXES = 4000  # fluxes at which the signal-to-noise ratio is computed, to find where it is 1


@runtime_checkable
class KnowsNoise(Protocol):
    """A response that derives the standard deviation of flux from its own formula, as those of photonpano do."""

    def flux_std(
        self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float, slope: Factor = 1.0, offset: Factor = 0.0
    ) -> NDArray[np.float32]:
        """Return the standard deviation of flux: see `flux_std`."""


@runtime_checkable
class Debiases(Protocol):
    """A response whose maximum-likelihood flux is biased, and that removes the bias."""

    def debiased(self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return the flux without bias: see `debiased`."""


def debiased(flux: FluxImage, weight: FluxImage, response: Response) -> FluxImage:
    """Remove the bias of maximum-likelihood flux, which binary frames have near saturation.

    Args:
        flux: any shape, photons per pixel per frame, from `Response.flux`; NaN stays NaN.
        weight: the same shape, number of frames that each pixel was seen in.
        response: the response of the camera. Of one that knows no bias, the flux is returned as it is.
    """
    return response.debiased(flux, weight) if isinstance(response, Debiases) else flux


def flux_std(flux: FluxImage, weight: FluxImage, response: Response, slope: Factor = 1.0, offset: Factor = 0.0) -> FluxImage:
    """Return the standard deviation of flux from photon noise and dark counts.

    For binary frames with d dark counts, `flux / std` is `sqrt(n) flux / sqrt(exp(flux + d) - 1)`, the bound of the binary
    model. Interpolation between pixels averages noise, which `photonpano.merging.averaging` considers.

    Args:
        flux: any shape, photons per pixel per frame; NaN stays NaN.
        weight: the same shape, number of frames that each pixel was seen in.
        response: the response of the camera. Of one that does not know its noise, the noise on its stabilised scale is taken,
            and the correction is not considered.
        slope: factor by which a correction, such as that of dark counts, has multiplied the counts; 1 where there is none.
        offset: what the correction has then added to the count of each frame: `-(exp(d) - 1)` for d dark counts.

    Returns:
        The same shape, float32; finite and positive where the flux is known.
    """
    if isinstance(response, KnowsNoise):
        return response.flux_std(flux, weight, slope, offset)
    floor = 1 / np.maximum(weight, 1)
    low = np.asarray(np.maximum(flux * (1 - _STEP), 0), np.float32)
    high = np.asarray(flux * (1 + _STEP) + _STEP * floor, np.float32)
    rise = response.stabilised(high, weight) - response.stabilised(low, weight)
    per_unit = (high - low) / np.maximum(rise, np.float32(1e-9))
    return np.asarray(response.stabilised_std(np.maximum(weight, 1)) * per_unit, np.float32)


def frame_variance(
    flux: FluxImage, response: Response, count: Callable[[FluxImage], FluxImage] = lambda flux: flux
) -> FluxImage:
    """Return the variance of the flux of one frame, for any response; of its count if that is a function of the flux.

    On the stabilised scale the noise is known; the derivative of that scale converts it.
    """
    floor = max(1e-4 * float(flux.max(initial=0)), 1e-7)
    low = np.asarray(np.maximum(flux * np.float32(0.98), floor), np.float32)
    high = np.asarray(np.maximum(flux * np.float32(1.02), 2 * floor), np.float32)
    steps = response.stabilised(high, _EXACT_FRAMES) - response.stabilised(low, _EXACT_FRAMES)
    per_step = np.abs((count(high) - count(low)) / np.maximum(steps, np.float32(1e-9)))
    return np.asarray(np.maximum(_EXACT_FRAMES * (response.stabilised_std(_EXACT_FRAMES) * per_step) ** 2, 1e-7), np.float32)


def saturated(flux: FluxImage, weight: FluxImage, response: Response) -> BoolArray:
    """Find the pixels that had the highest count in every frame, such as a photon in each binary one: flux is a lower bound.

    Args:
        flux: any shape, photons per pixel per frame; NaN counts as not saturated.
        weight: the same shape, number of frames that each pixel was seen in.
        response: the response of the camera.
    """
    frames = np.maximum(weight, 1)
    highest = response.mean_count(np.array([np.inf], np.float32))
    nearly = response.flux(np.asarray(highest - np.maximum(_NEARLY / frames, _ROUNDING * highest), np.float32), frames)
    return np.asarray((flux >= nearly) & (weight > 0))


@dataclass(frozen=True, slots=True)
class FluxRange:
    """A range of flux, in photons per pixel per frame."""

    low: float  # the lowest flux
    high: float  # the highest

    @property
    def decibels(self) -> float:
        """Ratio of both ends, 20 dB for a factor of ten."""
        return float(20 * np.log10(self.high / self.low))


def measurable_range(
    frames: float, response: Response, slope: float = 1.0, offset: float = 0.0, n_levels: int = _FLUXES
) -> FluxRange | None:
    """Return the range of flux that a number of frames measures with a signal-to-noise ratio of 1 or more.

    It ends at the flux of a pixel that is lit in all frames, since more cannot be measured.

    Args:
        frames: number of frames.
        response: the response of the camera.
        slope: see `flux_std`.
        offset: see `flux_std`.
        n_levels: fluxes that are tried.

    Returns:
        None if no flux is measured as well.
    """
    many = np.full(n_levels, _MANY_FRAMES, np.float32)  # of which the noise is that of the bound
    highest = float(response.flux(response.mean_count(np.array([np.inf], np.float32)), frames)[0])
    flux = np.geomspace(highest * 1e-12, highest, n_levels, dtype=np.float32)
    # Above 0, it is that of a line around the mean count of a curve through 0, as of a vignette: at low flux it does not hold.
    std = flux_std(flux, many, response, slope, min(offset, 0.0)) * np.sqrt(_MANY_FRAMES / frames)
    measured = flux[flux >= std]
    return FluxRange(float(measured[0]), float(measured[-1])) if len(measured) else None
