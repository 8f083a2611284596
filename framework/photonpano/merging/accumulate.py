"""Warp sums of frames onto a grid and add them up: what both virtual exposures and panoramas are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano.geometry import apply, corners, rescaling, translation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from photonpano.merging.chunks import Chunk
    from photonpano.protocols import Source
    from photonpano.values import FluxImage, Homography, Response

MIN_WEIGHT = 1.0
"""A pixel that was seen in less than one whole frame is unknown."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotonSum:
    """Warped counts, and how many frames each pixel was seen in.

    Attributes:
        counts: (H, W) float32.
        weight: (H, W) float32, in frames.
    """

    counts: FluxImage
    weight: FluxImage

    def estimate(self, response: Response) -> tuple[FluxImage, FluxImage]:
        """Return the flux of all counts together, one estimate a pixel (paper, equation 3), and its weight.

        Returns:
            Flux, (H, W) float32, NaN where less than one frame was seen; weight, (H, W) float32, 0 there.
        """
        known = self.weight >= MIN_WEIGHT
        weight = np.where(known, self.weight, np.float32(0))
        flux = np.full(self.counts.shape, np.nan, dtype=np.float32)
        seen = self.weight[known]
        flux[known] = response.flux(self.counts[known] / seen, seen)
        return flux, weight


def accumulate(
    source: Source,
    chunks: Iterable[Chunk],
    onto: Homography,
    shape: tuple[int, int],
    advance: Callable[[int], None] | None = None,
) -> PhotonSum:
    """Sum the frames of chunks on a grid, each chunk warped once.

    Convention:
        Points are (x, y), integers are pixel centres. Bilinear weights spread every count over the grid pixels whose centres
        see it; counts and weights are spread alike, so that their quotient is not biased at masks and borders.

    Args:
        source: the capture; masked pixels do not count.
        chunks: frames, with their maps to the reference plane.
        onto: (3, 3), pixels of the reference plane to pixels of the grid.
        shape: (height, width) of the grid.
        advance: is told the number of frames after each chunk.
    """
    counts = np.zeros(shape, dtype=np.float32)
    weight = np.zeros(shape, dtype=np.float32)
    valid = source.valid
    for chunk in chunks:
        summed = np.where(valid, source.counts(chunk.span), 0).astype(np.float32)
        seen = valid.astype(np.float32) * len(chunk.span)
        to_grid = onto @ chunk.homography
        shrink = _shrink_factor(to_grid, summed.shape)
        if shrink > 1:
            summed, seen = _shrunk(summed, shrink), _shrunk(seen, shrink)
            to_grid = to_grid @ rescaling(shrink)
        box = _bounding_box(to_grid, summed.shape, shape)
        if box is not None:
            rows, columns = box
            size = (columns.stop - columns.start, rows.stop - rows.start)
            to_box = translation(-columns.start, -rows.start) @ to_grid
            counts[box] += _warped(summed, to_box, size)
            weight[box] += _warped(seen, to_box, size)
        if advance is not None:
            advance(len(chunk.span))
    return PhotonSum(counts, weight)


def _warped(image: FluxImage, to_box: Homography, size: tuple[int, int]) -> FluxImage:
    # The inverse is taken here, in float64, because OpenCV would normalise it in its own way.
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(image, np.linalg.inv(to_box), size, flags=flags, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(warped, dtype=np.float32)


def _bounding_box(to_grid: Homography, frame: tuple[int, int], grid: tuple[int, int]) -> tuple[slice, slice] | None:
    """Return the rows and columns of the grid that a frame can touch; None if it lies outside."""
    points = apply(to_grid, corners(frame))
    low = np.maximum(np.floor(points.min(axis=0)) - 1, 0).astype(int)
    high = np.minimum(np.ceil(points.max(axis=0)) + 2, (grid[1], grid[0])).astype(int)
    if np.any(high <= low):
        return None
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def _shrink_factor(to_grid: Homography, frame: tuple[int, int]) -> int:
    """Return how many pixels in a row fall on one grid pixel: bilinear sampling alone would skip photons."""
    centre = np.array([[(frame[1] - 1) / 2, (frame[0] - 1) / 2]])
    around = apply(to_grid, centre + np.array([[0, 0], [1, 0], [0, 1]]))
    step = np.linalg.norm(around[1:] - around[0], axis=1).max()
    return max(1, int(1 / step + 1e-6))


def _shrunk(image: FluxImage, factor: int) -> FluxImage:
    """Average squares of `factor` pixels; what is missing of the last ones counts as unseen."""
    height, width = image.shape
    padded = np.pad(image, ((0, -height % factor), (0, -width % factor)))
    rows, columns = padded.shape[0] // factor, padded.shape[1] // factor
    return np.asarray(padded.reshape(rows, factor, columns, factor).mean(axis=(1, 3)), dtype=np.float32)
