"""Simulate a conventional camera: detected photons as grey levels, with read noise."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonpano.photometry import IntensityResponse
from photonpano_simulator.config import IntensitySensor


class IntensityCamera:
    """Pixels of level `black_level + (photons + read noise) / photons_per_level`, rounded and clipped at the highest level.

    Attributes:
        response: how flux becomes levels.
        bits: bits of a level.
        exposure: fraction of the frame period during which the shutter is open.
        valid: (H, W) bool, all True.
        gains: (H, W) float32, the sensitivity of each pixel, all 1.
    """

    kind: Literal["intensity"] = "intensity"

    def __init__(self, config: IntensitySensor, frame_shape: tuple[int, int]) -> None:
        self.bits, self.exposure = config.bits, config.exposure
        self._top, self._read_noise = 2**config.bits - 1, config.read_noise
        photons_per_level = config.full_well / (self._top - config.black_level)
        noise = float(np.hypot(config.read_noise, photons_per_level / np.sqrt(12)))
        self.response = IntensityResponse(photons_per_level, config.black_level, self._top, noise)
        self.valid: NDArray[np.bool_] = np.ones(frame_shape, np.bool_)
        self.gains: NDArray[np.float32] = np.ones(frame_shape, np.float32)

    def expose(self, flux: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.uint16]:
        """Take a frame.

        Args:
            flux: (H, W) expected number of detected photons per pixel.
            rng: the random generator of this frame.
        """
        photons = rng.poisson(flux) + self._read_noise * rng.standard_normal(flux.shape, np.float32)
        levels = photons / self.response.photons_per_level + self.response.black_level
        return np.clip(np.rint(levels), 0, self._top).astype(np.uint16)

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the sensor: nothing."""
        return {}
