"""Exporters: OpenEXR, with flux, weight, standard deviation and saturated pixels as channels of 32 bits, and Radiance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photonpano import FinishedPanorama
from photonpano_core.configs import ExrConfig

_BLOCK_ROWS = 256
_COMPRESSIONS = {"none": "NO_COMPRESSION", "zip": "ZIP_COMPRESSION", "zips": "ZIPS_COMPRESSION"}


class ExrExporter:
    """Writes channels `Y`, or `R`, `G` and `B`, with the flux, and layers `weight`, `std` and `saturated`.

    Unseen pixels are 0 and transparent (`A` is 0), since many viewers do not handle NaN.
    """

    def __init__(self, config: ExrConfig) -> None:
        import OpenEXR

        self._library = OpenEXR
        self._compression = getattr(OpenEXR, _COMPRESSIONS[config.compression])

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write the file: see `Exporter`. The channels are held in memory."""
        names = list("RGB") if panorama.in_colour else ["Y"]
        layers = {name: np.zeros((len(names), *panorama.shape), np.float32) for name in ("flux", "weight", "std", "saturated")}
        seen = np.zeros(panorama.shape, np.float32)
        for start in range(0, panorama.shape[0], _BLOCK_ROWS):
            stop = min(start + _BLOCK_ROWS, panorama.shape[0])
            rows = panorama.rows(start, stop)
            for name, layer in layers.items():
                image = np.nan_to_num(getattr(rows, name).astype(np.float32))
                layer[:, start:stop] = image[None] if image.ndim == 2 else np.moveaxis(image, -1, 0)
            known = np.isfinite(rows.flux)
            seen[start:stop] = known if known.ndim == 2 else known.all(axis=-1)
        channels: dict[str, NDArray[np.float32]] = {"A": seen}
        for layer_name, layer in layers.items():
            for name, image in zip(names, layer, strict=True):
                # `Y` is the flux of a grey panorama, `std` its standard deviation, `std.R` that of red.
                of_layer = layer_name if name == "Y" else f"{layer_name}.{name}"
                channels[name if layer_name == "flux" else of_layer] = image
        header = {
            "compression": self._compression,
            "type": self._library.scanlineimage,
            "comments": "flux in photons per pixel per frame; weight in frames; std: standard deviation of the flux",
        }
        with self._library.File(header, channels) as file:
            file.write(str(path))


class RadianceExporter:
    """Writes flux as .hdr, with an error of 0.4 % of the brightest colour of a pixel at most; unseen pixels are black."""

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write the file: see `Exporter`. The flux is held in memory."""
        import cv2

        flux = np.maximum(np.nan_to_num(panorama.rows(0, panorama.shape[0]).flux), 0)
        colours = np.repeat(flux[..., None], 3, axis=-1) if flux.ndim == 2 else flux[..., ::-1]
        brightest = colours.max(axis=-1, keepdims=True)
        # OpenCV cuts off what the 8 bits of a colour do not hold: half a step makes that rounding, which may lift the exponent.
        exponent = np.frexp(brightest * np.float32(256 / 255.5))[1]
        half_a_step = np.where(brightest > 0, np.ldexp(np.float32(0.5), exponent - 8), 0)
        path.write_bytes(cv2.imencode(".hdr", colours + half_a_step)[1].tobytes())
