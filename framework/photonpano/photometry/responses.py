"""Camera responses, flux to counts and back, and the noise of estimated flux.

The noise gives the standard deviation of the flux, and the range of flux that can be measured; beyond it, pixels are saturated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from photonpano.values import BoolArray, FluxImage, Response

Factor: TypeAlias = "NDArray[np.floating] | float"  # one number for all pixels, or one for each
_LEAST_DARK = 0.75  # a pixel with fewer dark frames was lit in all: half a dark frame is what `flux` assumes then


class _BinarySums:
    """The response of frames that are sums of `n` binary frames: noise is that of binary frames, n times as many."""

    __slots__ = ()
    n: int

    def mean_count(self, flux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the expected count of one frame: `n (1 - exp(-flux / n))` (equation 2)."""
        return -self.n * np.expm1(-flux / self.n)

    def flux(self, mean_count: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return the maximum-likelihood flux `-n ln(1 - mean_count / n)` (equation 3), at most `n ln(2 n frames)`."""
        ceiling = 1 - 0.5 / np.maximum(self.n * frames, 1)
        return np.asarray(-self.n * np.log1p(-np.clip(mean_count / self.n, 0, ceiling)), dtype=np.float32)

    def debiased(self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Remove the bias of maximum-likelihood flux, which is too high where few frames are dark.

        Half a dark frame is added: `-ln((n - k) / n)` of k counts in n frames becomes `-ln((n - k + 1/2) / (n + 1/2))`. With 5
        dark frames, the bias falls from 26 % of the standard deviation to 1 %. A pixel that is lit in all frames gets
        `ln(2 n + 1)`, a lower bound.
        """
        frames = np.maximum(self.n * frames, 1)
        lit = -np.expm1(-flux / self.n)
        lit = np.where((1 - lit) * frames < _LEAST_DARK, 1, lit)
        return np.asarray(-self.n * np.log1p(-lit * (frames / (frames + 0.5))), dtype=np.float32)

    def flux_std(
        self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float, slope: Factor = 1.0, offset: Factor = 0.0
    ) -> NDArray[np.float32]:
        """Return the standard deviation of flux estimated from `frames` frames: see `photonpano.photometry.flux_std`.

        Without corrections it is `sqrt((exp(flux) - 1) / frames)` for binary frames. One and a half lit frames and a dark one
        are added, so that 95 % of estimates lie within two standard deviations also where there are few of these, and it is
        positive where there are none.
        """
        frames = np.maximum(self.n * np.asarray(frames, np.float64), 1)
        dark = np.exp(-np.asarray(flux, np.float64) / self.n)
        raw_dark = np.clip((dark - 1 + slope + np.asarray(offset) / self.n) / slope, 0, 1)
        lit, unlit = frames * (1 - raw_dark) + 1.5, frames * raw_dark + 1
        spread = np.sqrt(lit * unlit / frames) / (frames + 2.5)
        return np.asarray(self.n * slope * spread / (dark + 0.5 / frames), dtype=np.float32)

    def stabilised(self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return `arcsin(sqrt((k + 3/8) / (n + 3/4)))` of k counts in n binary frames, from 0 to pi/2 (Anscombe 1948).

        It makes binomial noise uniform. Without the two fractions the mean of dark pixels would depend on the number of
        frames, and the ends of a merged exposure, which few frames saw, would look too dark.
        """
        frames = self.n * frames
        counts = np.clip(-np.expm1(-flux / self.n), 0, 1) * frames
        return np.asarray(np.arcsin(np.sqrt((counts + 0.375) / (frames + np.float32(0.75)))), dtype=np.float32)

    def stabilised_std(self, frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return `1 / (2 sqrt(n frames))`."""
        return np.asarray(0.5 / np.sqrt(self.n * frames), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class BinaryResponse(_BinarySums):
    """A pixel is 1 if it detected at least one photon (paper, equations 2 and 3).

    The mean count at flux `f` (detected photons per pixel per frame, dark counts included) is `1 - exp(-f)`.

    A pixel that is lit in all of n frames has no finite maximum-likelihood estimate. Half a frame is then counted as dark, so
    that its flux is `ln(2 n)`.
    """

    n: int = field(default=1, init=False, repr=False)


@dataclass(frozen=True, slots=True)
class BinarySumResponse(_BinarySums):
    """A frame is the sum of `n` binary frames, taken one after the other, so that a count goes from 0 to n.

    Flux is photons per pixel per frame, where a frame is the sum. Each binary frame gets the n-th part of it, so that the mean
    count at flux `f` is `n (1 - exp(-f / n))`. Noise is that of `BinaryResponse` for n times as many frames.
    """

    n: int  # number of binary frames in a sum


@dataclass(frozen=True, slots=True)
class IntensityResponse:
    """A pixel is a grey level, `black_level + flux / photons_per_level` up to saturation.

    Noise is photon noise and read noise, quantisation included: the variance of a frame is `flux + read_noise^2`, in photons
    squared.

    The flux of a saturated pixel is that of the saturation level, a lower bound. Flux below the black level is negative, so
    that averages of many frames are unbiased in the dark.
    """

    photons_per_level: float  # detected photons per grey level
    black_level: float  # grey level without light; may be a fraction
    saturation_level: float  # highest grey level
    read_noise: float  # standard deviation of the read noise of a pixel in a frame, in photons

    def mean_count(self, flux: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the expected grey level of one frame, at most the saturation level."""
        level = flux / self.photons_per_level + self.black_level
        return np.asarray(np.minimum(level, self.saturation_level), dtype=np.float32)

    def flux(self, mean_count: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return the flux of a mean grey level, whatever the number of frames; negative below the black level."""
        del frames
        level = np.minimum(mean_count, self.saturation_level)
        return np.asarray((level - self.black_level) * self.photons_per_level, dtype=np.float32)

    def flux_std(
        self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float, slope: Factor = 1.0, offset: Factor = 0.0
    ) -> NDArray[np.float32]:
        """Return the standard deviation of flux estimated from `frames` frames: see `photonpano.photometry.flux_std`.

        Without corrections it is `sqrt((flux + read_noise^2) / frames)`.
        """
        level = np.asarray(flux, np.float64) / self.photons_per_level + self.black_level
        raw = ((level - offset) / slope - self.black_level) * self.photons_per_level
        variance = np.maximum(raw, 0) + self.read_noise**2
        return np.asarray(slope * np.sqrt(variance / np.maximum(frames, 1)), dtype=np.float32)

    def stabilised(self, flux: NDArray[np.float32], frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return `sqrt(flux + read_noise^2 + 3 / (8 n))` of n frames: the generalised Anscombe transform.

        It makes photon noise and read noise together uniform (Makitalo and Foi 2013), here for a mean of n frames instead of
        their sum, so that exposures of different lengths are comparable.
        """
        shifted = flux + self.read_noise**2 + 0.375 / np.maximum(frames, 1)
        return np.asarray(np.sqrt(np.maximum(shifted, 0)), dtype=np.float32)

    def stabilised_std(self, frames: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Return `1 / (2 sqrt(frames))`."""
        return np.asarray(0.5 / np.sqrt(frames), dtype=np.float32)


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

    Flux is of any shape, photons per pixel per frame, from `Response.flux`, where NaN stays NaN; the weight is the number of
    frames that each pixel was seen in. For a response that knows no bias, the flux is returned as it is.
    """
    return response.debiased(flux, weight) if isinstance(response, Debiases) else flux


def flux_std(flux: FluxImage, weight: FluxImage, response: Response, slope: Factor = 1.0, offset: Factor = 0.0) -> FluxImage:
    """Return the standard deviation of flux from photon noise and dark counts.

    For binary frames with d dark counts, `flux / std` is `sqrt(n) flux / sqrt(exp(flux + d) - 1)`, the bound of the binary
    model. Interpolation between pixels averages noise, which `photonpano.merging.canvas_noise` considers.

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

    Flux is of any shape, photons per pixel per frame, where NaN counts as not saturated; the weight is the number of frames
    that each pixel was seen in.
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

    None if no flux is measured as well. It ends at the flux of a pixel that is lit in all frames, since more cannot be
    measured. For slope and offset, see `flux_std`; `n_levels` fluxes are tried.
    """
    many = np.full(n_levels, _MANY_FRAMES, np.float32)  # of which the noise is that of the bound
    highest = float(response.flux(response.mean_count(np.array([np.inf], np.float32)), frames)[0])
    flux = np.geomspace(highest * 1e-12, highest, n_levels, dtype=np.float32)
    # Above 0, it is that of a line around the mean count of a curve through 0, as of a vignette: at low flux it does not hold.
    std = flux_std(flux, many, response, slope, min(offset, 0.0)) * np.sqrt(_MANY_FRAMES / frames)
    measured = flux[flux >= std]
    return FluxRange(float(measured[0]), float(measured[-1])) if len(measured) else None
