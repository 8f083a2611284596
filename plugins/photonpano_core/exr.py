"""Write the panorama as OpenEXR: flux, weight, standard deviation and saturated pixels as channels of 32 bits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import OpenEXR

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import FinishedPanorama
    from photonpano_core.configs import ExrConfig

_BLOCK_ROWS = 256
_COLOURS = "RGB"
_COMPRESSIONS = {"none": OpenEXR.NO_COMPRESSION, "zip": OpenEXR.ZIP_COMPRESSION, "zips": OpenEXR.ZIPS_COMPRESSION}


class ExrExporter:
    """Writes channels `Y`, or `R`, `G` and `B`, with the flux, and layers `weight`, `std` and `saturated`.

    Unseen pixels are 0, and transparent: `A` is 1 where a pixel was seen, so that viewers need not know NaN.
    """

    def __init__(self, config: ExrConfig) -> None:
        self._compression = _COMPRESSIONS[config.compression]

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write the file: see `Exporter`. The channels are held in memory."""
        names = list(_COLOURS) if panorama.in_colour else ["Y"]
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
                channels[_channel(layer_name, name)] = image
        header = {
            "compression": self._compression,
            "type": OpenEXR.scanlineimage,
            "comments": "flux in photons per pixel per frame; weight in frames; std: standard deviation of the flux",
        }
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))


def _channel(layer: str, name: str) -> str:
    """Return the name of a channel: `Y` is the flux of a grey panorama, `std` its standard deviation, `std.R` that of red."""
    if layer == "flux":
        return name
    return layer if name == "Y" else f"{layer}.{name}"
