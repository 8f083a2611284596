"""Warp sums of frames onto a grid and add them up: what both virtual exposures and panoramas are made of."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import cv2
import numpy as np

from photonpano.geometry import translation
from photonpano.merging.chunks import Chunk
from photonpano.merging.footprints import Landing, landings
from photonpano.merging.warping import add_footprint, add_running_sums, add_warped, average_squares
from photonpano.protocols import LinearlyCorrectedSource, Source
from photonpano.values import Counts, FluxImage, FrameSpan, Homography, Response

_BATCH = 16
"""So many chunks are summed before they are added to the grid."""
_PART_ROWS = 128
"""A thread adds to about so many rows of the grid at a time."""
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
        unknown = self.weight < MIN_WEIGHT
        seen = np.asarray(np.maximum(self.weight, MIN_WEIGHT), dtype=np.float32)
        # Where dark counts were taken out, chance may leave less than nothing.
        mean = np.asarray(np.maximum(self.counts, 0) / seen, dtype=np.float32)
        flux, weight = response.flux(mean, seen), self.weight.copy()
        flux[unknown], weight[unknown] = np.nan, 0
        return flux, weight


def accumulate(
    source: Source,
    chunks: Sequence[Chunk],
    onto: Homography,
    shape: tuple[int, int],
    advance: Callable[[int], None] | None = None,
    pool: Executor | None = None,
    threads: int = 1,
    counts_of: Callable[[FrameSpan], Counts] | None = None,
) -> PhotonSum:
    """Sum the frames of chunks on a grid, each chunk warped once.

    Convention:
        Points are (x, y), integers are pixel centres. Bilinear weights spread every count over the grid pixels whose centres
        see it; counts and weights are spread alike, so that their quotient is not biased at masks and borders.

    Args:
        source: the capture; masked pixels do not count, and what a `LinearlyCorrectedSource` takes out of sums is taken out.
        chunks: frames, with their maps to the reference plane.
        onto: (3, 3), pixels of the reference plane to pixels of the grid.
        shape: (height, width) of the grid.
        advance: is told the number of frames of each chunk; first of all chunks together that miss the grid.
        pool: sums several chunks, and adds to several parts of the grid, at once; the result does not depend on it.
        threads: how many.
        counts_of: sums the frames of a span, if not the source itself; nothing is taken out of them yet.
    """
    total = _Total.zeros(shape)
    # Narrow enough that several threads find work wherever frames lie on the grid.
    n_parts = 1 if threads == 1 else max(threads, shape[0] // _PART_ROWS)
    parts = [total.rows(range(start, stop)) for start, stop in _divided(shape[0], n_parts)]
    masked = None if source.valid.all() else source.valid.astype(np.float32)
    corrected = source.corrected if isinstance(source, LinearlyCorrectedSource) else None
    placed = landings(onto @ np.array([chunk.homography for chunk in chunks]), source.info.frame_shape, shape)
    landed = [(chunk, landing) for chunk, landing in zip(chunks, placed, strict=True) if landing.rows and landing.columns]
    advance = advance or _no_one
    if missing := sum(len(chunk.span) for chunk in chunks) - sum(len(chunk.span) for chunk, _ in landed):
        advance(missing)
    # What is started is worked on while the next is started, if there is a pool; results are taken in order.
    start = pool.map if pool else map
    adding: Iterable[None] = ()
    for first in range(0, len(landed), _BATCH):
        batch = landed[first : first + _BATCH]
        summed = list(start(partial(_summed, counts_of or source.counts, corrected, masked), *zip(*batch, strict=True)))
        deque(adding, maxlen=0)
        adding = start(partial(_Total.add, summed=summed), parts)
        for chunk, _ in batch:
            advance(len(chunk.span))
    deque(adding, maxlen=0)
    return total.result()


@dataclass(frozen=True, slots=True, eq=False)
class _Summed:
    """The sum of the frames of a chunk, and where it goes.

    Attributes:
        landing: how it is brought onto the grid.
        n_frames: how many frames it is made of.
        counts: (h, w) float32 or uint32.
        seen: (h, w) float32, in how many frames each pixel was seen; None if in all.
    """

    landing: Landing
    n_frames: int
    counts: FluxImage | Counts
    seen: FluxImage | None


def _summed(
    counts_of: Callable[[FrameSpan], Counts],
    corrected: Callable[[Counts, int], FluxImage] | None,
    masked: FluxImage | None,
    chunk: Chunk,
    landing: Landing,
) -> _Summed:
    n_frames, shrink = len(chunk.span), landing.shrink
    raw = counts_of(chunk.span)
    counts: FluxImage | Counts = np.ascontiguousarray(raw)
    if corrected is not None:
        counts = np.ascontiguousarray(corrected(raw, n_frames))
    if masked is not None:
        lit, seen = counts.astype(np.float32) * masked, masked * np.float32(n_frames)
        return _Summed(landing, n_frames, average_squares(lit, shrink), average_squares(seen, shrink))
    if shrink == 1:
        return _Summed(landing, n_frames, counts if landing.straight else counts.astype(np.float32), None)
    whole = not any(side % shrink for side in counts.shape)
    everywhere = None if whole else average_squares(np.full(counts.shape, n_frames, np.float32), shrink)
    return _Summed(landing, n_frames, average_squares(counts, shrink), everywhere)


@dataclass(frozen=True, slots=True, eq=False)
class _Total:
    """Some rows of the grid.

    Attributes:
        first: the number of the first row.
        counts: (H, W) float32.
        weight: (H, W) float32, but for
        steps: (H, W + 1) float32 whose sums along rows belong to it: frames that saw everything change it at their ends only.
    """

    first: int
    counts: FluxImage
    weight: FluxImage
    steps: FluxImage

    @classmethod
    def zeros(cls, shape: tuple[int, int]) -> _Total:
        height, width = shape
        return cls(0, *(np.zeros((height, columns), np.float32) for columns in (width, width, width + 1)))

    def rows(self, rows: range) -> _Total:
        """Return the part that holds some of the rows; what is added to it is added here."""
        part = slice(rows.start, rows.stop)
        return _Total(rows.start, self.counts[part], self.weight[part], self.steps[part])

    def add(self, summed: Sequence[_Summed]) -> None:
        """Add sums of chunks, in order."""
        for each in summed:
            if each.landing.rows.start >= self.first + len(self.counts) or each.landing.rows.stop <= self.first:
                continue
            to_image = each.landing.to_image @ translation(0, self.first)
            if each.seen is None:
                add_footprint(each.counts.shape, to_image, float(each.n_frames), self.steps, self.weight)
            else:
                self._warp(each.seen, each.landing, to_image, self.weight)
            self._warp(each.counts, each.landing, to_image, self.counts)

    def _warp(self, image: FluxImage | Counts, landing: Landing, to_image: Homography, total: FluxImage) -> None:
        if landing.straight:
            add_warped(image, to_image, total)
            return
        rows = range(max(landing.rows.start - self.first, 0), min(landing.rows.stop - self.first, len(total)))
        if rows and landing.columns:
            size = len(landing.columns), len(rows)
            to_image = to_image @ translation(landing.columns.start, rows.start)
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            box = slice(rows.start, rows.stop), slice(landing.columns.start, landing.columns.stop)
            total[box] += cv2.warpPerspective(image, to_image, size, flags=flags, borderMode=cv2.BORDER_CONSTANT)

    def result(self) -> PhotonSum:
        add_running_sums(self.steps, self.weight)
        return PhotonSum(self.counts, self.weight)


def _no_one(_: int) -> None:
    """Listen to no progress."""


def _divided(length: int, parts: int) -> list[tuple[int, int]]:
    """Divide a length into parts that are about equal."""
    bounds = [length * part // parts for part in range(parts + 1)]
    return [(start, stop) for start, stop in pairwise(bounds) if start < stop]
