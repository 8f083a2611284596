"""The panorama at a glance: as it is, or averaged down where it is rendered in tiles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.geometry import rescaling
from photonpano.values import Panorama

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from photonpano.geometry import Canvas
    from photonpano.pipeline.panorama import Tile
    from photonpano.values import FluxImage


class Overview:
    """Gathers tiles into a panorama that is smaller by a whole factor.

    Args:
        canvas: what the tiles are parts of.
        reduction: so many pixels squared become one; tiles begin at multiples of it. 1 keeps the only tile as it is.
    """

    def __init__(self, canvas: Canvas, reduction: int) -> None:
        self._reduction = reduction
        self._n_pixels, self._n_seen = canvas.height * canvas.width, 0
        shape = -(-canvas.height // reduction), -(-canvas.width // reduction)
        to_overview = rescaling(1 / reduction) @ canvas.transform
        empty = np.zeros((0, 0) if reduction == 1 else shape, np.float32)
        self.panorama = Panorama(empty, empty.copy(), to_overview)

    def add(self, tile: Tile, rendered: Panorama) -> None:
        """Enter a tile: the mean flux of the pixels that were seen, and the mean weight of all."""
        step = self._reduction
        known = rendered.weight > 0
        self._n_seen += int(np.count_nonzero(known))
        if step == 1:
            self.panorama = rendered
            return
        share = _averaged(known, step)
        height, width = share.shape
        box = np.s_[tile.top // step : tile.top // step + height, tile.left // step : tile.left // step + width]
        flux = _averaged(np.where(known, rendered.flux, 0), step)
        self.panorama.flux[box] = np.divide(flux, share, out=np.full_like(flux, np.nan), where=share > 0)
        self.panorama.weight[box] = _averaged(rendered.weight, step)

    @property
    def coverage_share(self) -> float:
        """The share of the canvas that was seen."""
        return self._n_seen / self._n_pixels


def _averaged(image: NDArray[np.generic], step: int) -> FluxImage:
    """Average squares of pixels; what a square lacks at the right and at the bottom counts as zero."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % step), (0, -width % step))).astype(np.float32, copy=False)
    blocks = padded.reshape(padded.shape[0] // step, step, padded.shape[1] // step, step)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
