"""Warp sums of frames onto a grid and add them up: what both virtual exposures and panoramas are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano.geometry import apply, corners, inverse, rescaling, translation
from photonpano.geometry.sampling import run_px
from photonpano.merging.warping import add_footprint, add_warped

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from photonpano.merging.chunks import Chunk
    from photonpano.protocols import Source
    from photonpano.values import FluxImage, Homography, Response

_LONG_RUN_PX = 96
"""Shorter runs of neighbours are warped faster pixel by pixel."""
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
    steps = np.zeros((shape[0], shape[1] + 1), dtype=np.float32)
    masked = None if source.valid.all() else source.valid.astype(np.float32)
    frame = np.empty(source.info.frame_shape, dtype=np.float32)
    for chunk in chunks:
        frame[...] = source.counts(chunk.span)
        if masked is not None:
            frame *= masked
        summed = frame
        to_grid = onto @ chunk.homography
        shrink = _shrink_factor(to_grid, summed.shape)
        n_frames = float(len(chunk.span))
        if shrink > 1:
            seen = np.ones_like(summed) if masked is None else masked
            summed, seen = _shrunk(summed, shrink), _shrunk(seen, shrink)
            to_grid = to_grid @ rescaling(shrink)
            _add(seen * np.float32(n_frames), to_grid, weight)
        elif masked is not None:
            _add(masked * np.float32(n_frames), to_grid, weight)
        else:
            add_footprint(summed.shape, inverse(to_grid), n_frames, steps, weight)
        _add(summed, to_grid, counts)
        if advance is not None:
            advance(len(chunk.span))
    weight += np.cumsum(steps, axis=1, dtype=np.float64)[:, :-1].astype(np.float32)
    return PhotonSum(counts, weight)


def _add(image: FluxImage, to_grid: Homography, total: FluxImage) -> None:
    """Add an image to a grid, interpolated linearly."""
    box = _bounding_box(to_grid, image.shape, total.shape)
    if box is None:
        return
    rows, columns = box
    to_image = inverse(to_grid)
    if run_px(to_image, rows, columns) >= _LONG_RUN_PX:
        add_warped(np.ascontiguousarray(image), to_image, total)
        return
    # The inverse is taken here, in float64, because OpenCV would normalise it in its own way.
    flags, size = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, (columns.stop - columns.start, rows.stop - rows.start)
    to_image = to_image @ translation(columns.start, rows.start)
    total[box] += cv2.warpPerspective(image, to_image, size, flags=flags, borderMode=cv2.BORDER_CONSTANT)


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
