"""Convert the levels of a file to levels that are linear in flux, so that frames can be summed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.photometry import IntensityResponse, srgb_to_linear
from photonpano.reading import reading
from photonpano_sensors.intensity.configs import ResponseConfig

_MOST = 2**16 - 1  # the highest linear level


@dataclass(frozen=True, slots=True)
class Encoding:
    """The encoding of the levels of a file."""

    bits: int  # bits of a level
    black: float  # the level without light
    white: float  # the level at which a pixel saturates

    @classmethod
    def full(cls, bits: int) -> Encoding:
        """Return the encoding that uses all levels."""
        return cls(bits, 0.0, 2.0**bits - 1)


@dataclass(frozen=True, slots=True, eq=False)
class LinearLevels:
    """The conversion of levels of a file to linear levels, and their response."""

    bits: int  # bits of a linear level
    # (2^b,), the linear level of each level of a file of b bits; None if these are linear already
    table: NDArray[np.uint16] | None
    response: IntensityResponse  # how flux becomes linear levels


def linear_levels(config: ResponseConfig, encoding: Encoding) -> LinearLevels:
    """Return the conversion of the levels of a file to linear levels.

    The curve is continued below black, point-symmetrically, so that noise in the dark is not clipped. Quantisation noise, that
    of the levels in the middle of the range, is added to the read noise. Raises an `InputError` if the levels, or a file, do
    not suit.
    """
    black = encoding.black if config.black_level is None else config.black_level
    white = encoding.white if config.white_level is None else config.white_level
    top = 2**encoding.bits - 1
    if not black < white <= top:
        raise InputError(
            f"black_level {black:g} and white_level {white:g} do not suit levels of {encoding.bits} bits: "
            f"black must be below white, and white at most {top}"
        )
    photons_per_level = config.saturation_photons / (white - black)
    read_noise = float(np.hypot(config.read_noise, photons_per_level / np.sqrt(12)))
    if config.curve == "linear" and config.curve_file is None:
        return LinearLevels(encoding.bits, None, IntensityResponse(photons_per_level, black, white, read_noise))
    light = _light(config, (np.arange(top + 1) - black) / (white - black))
    if config.curve_file is not None:
        at_black, at_white = np.interp([black, white], np.arange(top + 1), light)
        if not at_black < at_white:
            raise InputError(f"{config.curve_file}: the curve does not rise from the black level to the white level")
        light = (light - at_black) / (at_white - at_black)
    lowest = min(float(light[0]), 0.0)
    scale = _MOST / (max(float(light[-1]), 1.0) - lowest)
    table = np.rint((light - lowest) * scale).astype(np.uint16)
    # Integers, so that the flux of a black frame is exactly 0.
    zero, one = round(-lowest * scale), round((1 - lowest) * scale)
    return LinearLevels(16, table, IntensityResponse(config.saturation_photons / (one - zero), zero, one, read_noise))


def _light(config: ResponseConfig, encoded: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the light of encoded levels that are 0 at black and 1 at white; in arbitrary units if it comes from a file."""
    if config.curve_file is not None:
        return _measured(config.curve_file, len(encoded))
    size = np.abs(encoded)
    if isinstance(config.curve, str):
        return np.sign(encoded) * srgb_to_linear(size)
    return np.asarray(np.sign(encoded) * size**config.curve)


def _measured(path: Path, n_levels: int) -> NDArray[np.float64]:
    with reading(path, "is not a text file of numbers, one for each level"):
        light = np.array([float(word) for word in path.read_text(encoding="utf-8").split()])
    if len(light) != n_levels:
        raise InputError(f"{path} holds {len(light)} numbers; the levels of the capture are {n_levels}")
    if not (np.all(np.isfinite(light)) and np.all(np.diff(light) >= 0)):
        raise InputError(f"{path}: the numbers must be finite, and none smaller than the one before")
    return light
