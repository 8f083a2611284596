"""A single-photon camera: which pixels detect a photon in a frame period."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import BinaryResponse
from photonpano_simulator.chance import Draw, generator
from photonpano_simulator.config import Sensor
from photonpano_simulator.files import read_mask, read_rates


class SpadSensor:
    """Pixels that are 1 with the probability `1 - exp(-(q * flux + dark))` (paper, equation 2), and 0 else.

    Attributes:
        response: how flux becomes counts.
        dark_rates: (H, W) float32, dark counts per frame period, those of hot pixels included.
        hot: (H, W) bool, the hot pixels.
        valid: (H, W) bool, false for hot pixels that the capture tells of.

    Raises:
        InputError: a file of rates or of hot pixels cannot be used.
    """

    kind: Literal["binary"] = "binary"
    bits = 1
    exposure = 0.0

    def __init__(self, config: Sensor, frame_shape: tuple[int, int], seed: int) -> None:
        self.response = BinaryResponse()
        rng = generator(seed, Draw.HOT_PIXELS)
        self.hot: NDArray[np.bool_] = rng.random(frame_shape) < config.hot_fraction
        if config.hot_pixels is not None:
            self.hot |= read_mask(config.hot_pixels, frame_shape)
        self.dark_rates: NDArray[np.float32] = np.full(frame_shape, config.dark_rate, np.float32)
        if config.dark_rates is not None:
            self.dark_rates += read_rates(config.dark_rates, frame_shape)
        low, high = np.log(config.hot_rate)
        hot_rates = np.exp(rng.uniform(float(low), float(high), frame_shape)).astype(np.float32)
        self.dark_rates[self.hot] += hot_rates[self.hot]
        self._minus_dark_rates = -self.dark_rates
        self.valid: NDArray[np.bool_] = ~self.hot if config.mask_hot_pixels else np.ones(frame_shape, np.bool_)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return what else is true: `dark_rates` and `hot_pixels`."""
        return {"dark_rates": self.dark_rates, "hot_pixels": self.hot}

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Take a frame.

        Args:
            flux: (H, W) photons that are detected per pixel per frame, dark counts not included; it is overwritten.
            rng: the chance of this frame.
        """
        # The chance that no photon is detected, less one: -p.
        chance = np.expm1(np.subtract(self._minus_dark_rates, flux, out=flux), out=flux)
        threshold = np.multiply(chance, _MINUS_RANGE, out=chance).astype(np.uint32)
        # Whole numbers of 64 bits are drawn faster than floats; each serves two pixels.
        n_pixels = flux.size
        draws = rng.integers(0, 2**64, -(-n_pixels // 2), dtype=np.uint64).view(np.uint32)[:n_pixels]
        return draws.reshape(flux.shape) < threshold


_MINUS_RANGE = np.float32(2.0**8 - 2.0**32)
"""The range of the draws, negative: the largest that float32 and uint32 share. It misses 2^32 by what float32 cannot tell."""
