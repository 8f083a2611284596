"""Simulate sensors: pixels that detect a photon or none, and conventional ones, which count photons with noise."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from photonpano import Bayer, InputError
from photonpano.photometry import BinaryResponse, IntensityResponse
from photonpano.reading import COLOURS, bayer_array, read_array, read_filter_array
from photonpano_simulator.config import IntensitySensor, Sensor

_KEPT = 16  # frames that are remembered for those that follow them, read by several threads
Incident: TypeAlias = Callable[[int], NDArray[np.float32]]
"""Returns the photons that are detected per pixel in a frame that is taken, without dark counts: (H, W), a new array."""

# The range of the draws, negated: 2^32 - 2^8 is the largest number below 2^32 that float32 represents.
_MINUS_RANGE = np.float32(2.0**8 - 2.0**32)


class Draw(IntEnum):
    """The random quantities of a simulation, each with a generator of its own."""

    PHOTONS = 0
    HOT_PIXELS = 1
    SHAKE = 2
    PATH = 3
    GAINS = 4
    DIRT = 5
    TEXTURE = 6
    SCENE = 7
    GAZE = 8
    CLUTTER = 9
    PEOPLE = 10
    AFTERPULSES = 11
    CROSSTALK = 12
    DEAD_TIME = 13


def generator(seed: int, draw: Draw, index: int = 0) -> np.random.Generator:
    """Return a generator that depends on these three numbers alone."""
    # SFC64 is the fastest generator of numpy. The numbers are hashed, not added, so that the streams are independent.
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=(draw, index))))


class SpadSensor:
    """Pixels that are 1 with the probability `1 - exp(-(q * flux + dark))` (paper, equation 2), and 0 else.

    Attributes:
        dark_rates: (H, W) float32, dark counts per frame period, those of hot pixels included.
        hot: (H, W) bool, the hot pixels.
        valid: (H, W) bool, False for hot pixels if the config masks them.
        gains: (H, W) float32, the sensitivity of each pixel, dirt included; 1 for an ideal one.
    """

    kind: Literal["binary"] = "binary"
    bits = 1
    exposure = 0.0

    def __init__(self, config: Sensor, frame_shape: tuple[int, int], seed: int) -> None:
        self.response = BinaryResponse()
        self._config, self._seed = config, seed
        if config.afterpulsing:
            self._detected = lru_cache(_KEPT)(self._detected)  # type: ignore[method-assign]
        self._rate, self._blind_after = lru_cache(_KEPT)(self._rate_of), lru_cache(_KEPT)(self._blinded)
        rng = generator(seed, Draw.HOT_PIXELS)
        self.hot: NDArray[np.bool_] = rng.random(frame_shape) < config.hot_fraction
        if config.hot_pixels is not None:
            mask = read_array(config.hot_pixels, "a mask")
            if mask.shape != frame_shape or mask.dtype != np.bool_:
                found = f"{mask.dtype} of shape {mask.shape}"
                raise InputError(f"{config.hot_pixels} holds {found}; a mask is bool of the frame's shape {frame_shape}")
            self.hot |= mask
        self.dark_rates: NDArray[np.float32] = np.full(frame_shape, config.dark_rate, np.float32)
        if config.dark_rates is not None:
            rates = read_array(config.dark_rates, "a file of rates")
            if rates.shape != frame_shape or rates.dtype.kind not in "fiu":
                found = f"{rates.dtype} of shape {rates.shape}"
                raise InputError(f"{config.dark_rates} holds {found}; rates are numbers of the frame's shape {frame_shape}")
            if not (np.all(np.isfinite(rates)) and np.all(rates >= 0)):
                raise InputError(f"{config.dark_rates} holds rates that are negative or not finite")
            self.dark_rates += rates.astype(np.float32)
        low, high = np.log(config.hot_rate)
        hot_rates = np.exp(rng.uniform(float(low), float(high), frame_shape)).astype(np.float32)
        self.dark_rates[self.hot] += hot_rates[self.hot]
        self._minus_dark_rates = -self.dark_rates
        self.valid: NDArray[np.bool_] = ~self.hot if config.mask_hot_pixels else np.ones(frame_shape, np.bool_)
        gains = np.maximum(1 + config.gain_std * generator(seed, Draw.GAINS).standard_normal(frame_shape), 0)
        if config.dirt is not None:
            dirt, (height, width) = config.dirt, frame_shape
            through = np.ones(frame_shape)  # the share of the light that passes the specks
            for x, y in generator(seed, Draw.DIRT).uniform((0, 0), (width, height), (dirt.specks, 2)):
                across = np.exp(-((np.arange(width) - x) ** 2) / (2 * dirt.radius_px**2))
                down = np.exp(-((np.arange(height) - y) ** 2) / (2 * dirt.radius_px**2))
                through *= 1 - dirt.loss * np.outer(down, across)
            gains *= through
        self.gains: NDArray[np.float32] = gains.astype(np.float32)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the sensor: `dark_rates` and `hot_pixels`."""
        return {"dark_rates": self.dark_rates, "hot_pixels": self.hot}

    def frame(self, index: int, incident: Incident) -> NDArray[np.bool_]:
        """Take a frame with afterpulses and crosstalk, which depends on this frame and those before alone.

        Only detections have afterpulses, and these trigger no further ones; neither does crosstalk.
        """
        fired, shape = self._detected(index, incident), self.dark_rates.shape
        if self._config.afterpulsing and index:
            draws = generator(self._seed, Draw.AFTERPULSES, index).random(shape, np.float32)
            fired = fired | (self._detected(index - 1, incident) & (draws < self._config.afterpulsing))
        if self._config.crosstalk:
            draws = generator(self._seed, Draw.CROSSTALK, index).random((4, *shape), np.float32)
            right, left, down, up = (fired & (each < self._config.crosstalk) for each in draws)
            fired = fired.copy()
            fired[:, 1:] |= right[:, :-1]
            fired[:, :-1] |= left[:, 1:]
            fired[1:] |= down[:-1]
            fired[:-1] |= up[1:]
        return fired

    def _detected(self, index: int, incident: Incident) -> NDArray[np.bool_]:
        """Return which pixels detect a photon, or a dark count: (H, W)."""
        rng = generator(self._seed, Draw.PHOTONS, index)
        if not self._config.dead_time:
            return self.expose(incident(index), rng)
        # A detection in the last dead time of a frame is drawn first. A pixel that has none is dark with the probability with
        # which it is dark in all of the frame, exp(-rate * seeing), divided by that of none there.
        rate, late = self._rate(index, incident), self._blind_after(index, incident) > 0
        seeing = 1 - self._blind_after(index - 1, incident) if index else np.float32(1)
        dark = np.exp(-rate * seeing) * (1 + self._config.dead_time * rate)
        return np.asarray(late | (rng.random(rate.shape, np.float32) >= dark))

    def _rate_of(self, index: int, incident: Incident) -> NDArray[np.float32]:
        return incident(index) + self.dark_rates

    def _blinded(self, index: int, incident: Incident) -> NDArray[np.float32]:
        """Return for how long pixels are blind in the next frame, in frame periods: (H, W).

        A pixel that is blind for d after each detection detects rate / (1 + d rate) photons, and at most one in the time d: as
        many in the last d of a frame, each at any time there.
        """
        dead = np.float32(self._config.dead_time)
        expected = dead * self._rate(index, incident)
        chance = np.maximum(expected / (1 + expected), np.finfo(np.float32).tiny)
        draws = generator(self._seed, Draw.DEAD_TIME, index).random(chance.shape, np.float32)
        return np.where(draws < chance, dead * (1 - draws / chance), np.float32(0))

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Take a frame of (H, W) photons that are detected per pixel, without dark counts; `flux` is overwritten."""
        # -p: the probability that no photon is detected, minus 1.
        chance = np.expm1(np.subtract(self._minus_dark_rates, flux, out=flux), out=flux)
        threshold = np.multiply(chance, _MINUS_RANGE, out=chance).astype(np.uint32)
        # Integers of 64 bits, each for two pixels, are drawn faster than floats.
        n_pixels = flux.size
        draws = rng.integers(0, 2**64, -(-n_pixels // 2), dtype=np.uint64).view(np.uint32)[:n_pixels]
        return draws.reshape(flux.shape) < threshold


class IntensityCamera:
    """Pixels of level `black_level + (photons + read noise) / photons_per_level`, rounded and clipped at the highest level."""

    kind: Literal["intensity"] = "intensity"

    def __init__(self, config: IntensitySensor, frame_shape: tuple[int, int], seed: int) -> None:
        self._seed = seed
        self.bits, self.exposure = config.bits, config.exposure
        self._top, self._read_noise = 2**config.bits - 1, config.read_noise
        photons_per_level = config.full_well / (self._top - config.black_level)
        noise = float(np.hypot(config.read_noise, photons_per_level / np.sqrt(12)))
        self.response = IntensityResponse(photons_per_level, config.black_level, self._top, noise)
        self.valid: NDArray[np.bool_] = np.ones(frame_shape, np.bool_)
        self.gains: NDArray[np.float32] = np.ones(frame_shape, np.float32)

    def frame(self, index: int, incident: Incident) -> NDArray[np.uint16]:
        """Take a frame."""
        return self.expose(incident(index), generator(self._seed, Draw.PHOTONS, index))

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
        """Take a frame of (H, W) expected detected photons per pixel."""
        photons = rng.poisson(flux) + self._read_noise * rng.standard_normal(flux.shape, np.float32)
        levels = photons / self.response.photons_per_level + self.response.black_level
        return np.clip(np.rint(levels), 0, self._top).astype(np.uint16)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the sensor: nothing."""
        return {}


def bayer_of(config: Sensor | IntensitySensor) -> Bayer | None:
    """Return the Bayer array before the pixels; None for other filters."""
    filters = config.filters if isinstance(config, Sensor) else None
    return None if isinstance(filters, Path) else filters


def filter_array(config: Sensor, frame_shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return what each pixel sees of red, green and blue, 1 or 0: (H, W, 3); None for a sensor without colour filters."""
    if config.filters is None:
        return None
    if isinstance(config.filters, Path):
        places = read_filter_array(config.filters)
        if places.shape != frame_shape:
            raise InputError(
                f"{config.filters} has the shape {places.shape}; sensor.filters needs that of the frame, {frame_shape}"
            )
    else:
        places = bayer_array(config.filters, frame_shape)
    return (np.array(list(COLOURS.values())) / 255).astype(np.float32)[places]
