"""Write the panorama as a Radiance picture: 8 bits a colour with a common exponent."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano import FinishedPanorama

_BLOCK_ROWS = 256


class RadianceExporter:
    """Writes flux as .hdr, with an error of 0.4 % of the brightest colour of a pixel at most; unseen pixels are black."""

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write the file: see `Exporter`."""
        height, width = panorama.shape
        with path.open("wb") as file:
            file.write(f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode())
            for start in range(0, height, _BLOCK_ROWS):
                file.write(encoded(panorama.rows(start, min(start + _BLOCK_ROWS, height)).flux).tobytes())


def encoded(flux: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return red, green, blue and exponent of each pixel (Ward 1991): (h, w, 4).

    Args:
        flux: (h, w), or (h, w, 3) of red, green and blue; negative and unknown flux becomes 0.
    """
    colours = np.maximum(np.nan_to_num(flux), 0)
    colours = np.repeat(colours[..., None], 3, axis=-1) if colours.ndim == 2 else colours
    brightest = colours.max(axis=-1)
    # Rounding must not lift a mantissa to 256.
    mantissa, exponent = np.frexp(brightest)
    exponent = np.where(mantissa > 255.5 / 256, exponent + 1, exponent)
    pixels = np.zeros((*brightest.shape, 4), np.uint8)
    lit = (brightest > 0) & (exponent > -128)
    pixels[lit, :3] = np.rint(np.ldexp(colours[lit], (8 - exponent[lit])[:, None])).astype(np.uint8)
    pixels[lit, 3] = np.clip(exponent[lit] + 128, 1, 255)
    return pixels
