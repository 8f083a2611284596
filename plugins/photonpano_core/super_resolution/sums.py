"""Sort the photons of frames into the cells of a canvas: those that an estimate is made from, and those held out.

Pixels whose centres fall into one cell of the grid see nearly the same light, whatever their frame: their counts are summed,
and so are their frames. A capture becomes two images, on which each round of an estimate works, not on the frames.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import TypeAlias

import numpy as np

from photonpano import BoolArray, Capture, FloatArray, FluxImage, Homography, Source, capture_of
from photonpano.compiling import compiled
from photonpano.geometry import Canvas, corners, transform_points
from photonpano.merging import Chunk, LightTerms, LitFrames, divided
from photonpano.photometry import BinaryResponse, BinarySumResponse

_BATCH = 16  # chunks that are summed before they are added to the grid
_PART_ROWS = 64  # approximate number of rows of the grid that a thread adds to at a time
_Summed: TypeAlias = tuple[FluxImage, FluxImage, BoolArray]  # see `_summed`

_UP = 0.5 + 1e-6  # a centre on the border of two cells belongs to the second one, whatever the rounding of its coordinates


@dataclass(frozen=True, slots=True, eq=False)
class PhotonSums:
    """Sums over the frames whose pixels fall into each cell of a grid."""

    lit: FluxImage  # (H, W), counts. For a camera that does not count single photons, they are photons
    seen: FluxImage  # (H, W), frames, or binary frames where a frame is a sum of these; in changing light, their gains
    light: LitFrames | None  # frames and gains by the class of their light; None in steady light

    def part(self, box: tuple[slice, slice]) -> PhotonSums:
        """Return some rows and columns."""
        lit, seen = (np.ascontiguousarray(each[box]) for each in (self.lit, self.seen))
        return PhotonSums(lit, seen, None if self.light is None else self.light.part(box))


def visible(chunks: Sequence[Chunk], canvas: Canvas, frame_shape: tuple[int, int]) -> list[Chunk]:
    """Return the chunks whose frames may reach into a canvas."""
    if not chunks:
        return []
    outlines = transform_points(canvas.transform @ np.array([chunk.homography for chunk in chunks]), corners(frame_shape))
    low, high = outlines.min(axis=1) - 1, outlines.max(axis=1) + 1
    inside = (high >= 0).all(axis=1) & (low <= [canvas.width - 1, canvas.height - 1]).all(axis=1)
    return [chunk for chunk, flag in zip(chunks, inside, strict=True) if flag]


def sums_on(
    source: Source, chunks: Sequence[Chunk], canvas: Canvas, advance: Callable[[int], None], pool: Executor
) -> PhotonSums:
    """Sum the counts and the frames of the pixels whose centres fall into each cell of a canvas."""
    capture = capture_of(source)
    terms = None if capture.light is None else LightTerms.of(capture.light, [chunk.span for chunk in chunks])
    lit = np.zeros(canvas.shape, np.float32)
    seen = np.zeros((1 if terms is None else terms.number, *canvas.shape), np.float32)
    parts = divided(canvas.height, max(1, canvas.height // _PART_ROWS))
    adding: Iterable[None] = ()
    for first in range(0, len(chunks), _BATCH):
        batch = chunks[first : first + _BATCH]
        summed = list(pool.map(partial(_summed, capture, terms), batch))
        deque(adding, maxlen=0)
        to_grid = [np.ascontiguousarray(canvas.transform @ chunk.homography) for chunk in batch]
        adding = pool.map(partial(_add, summed, to_grid, lit, seen), parts)
        for chunk in batch:
            advance(len(chunk.span))
    deque(adding, maxlen=0)
    lit_frames = None if terms is None else terms.lit_frames(seen, canvas)
    return _photons(source, lit, seen[0], lit_frames)


def _summed(capture: Capture, terms: LightTerms | None, chunk: Chunk) -> _Summed:
    """Return the counts of a chunk, (h, w), what a pixel adds to each image of frames and gains, (P,), and which pixels do."""
    amounts = np.array([len(chunk.span)], np.float32) if terms is None else terms.amounts(chunk.span).astype(np.float32)
    usable = np.ascontiguousarray(capture.masked_in(chunk.span).valid)
    return np.ascontiguousarray(capture.corrected_counts(chunk.span), np.float32), amounts, usable


def _add(
    summed: Sequence[_Summed],
    to_grid: Sequence[Homography],
    lit: FluxImage,
    seen: FluxImage,
    rows: range,
) -> None:
    part = slice(rows.start, rows.stop)
    for (counts, amounts, usable), homography in zip(summed, to_grid, strict=True):
        add_observations(counts, usable, amounts, homography, rows.start, lit[part], seen[:, part])


def _photons(source: Source, lit: FluxImage, seen: FluxImage, light: LitFrames | None) -> PhotonSums:
    # Subtraction of dark counts can leave a negative sum by chance.
    lit = np.maximum(lit, 0, out=lit)
    frames = seen if light is None else np.asarray(light.frames.sum(axis=0), np.float32)
    if light is not None:
        seen = light.weight
    match source.response:
        case BinaryResponse():
            return PhotonSums(np.minimum(lit, frames, out=lit), seen, light)
        case BinarySumResponse(n):
            light = None if light is None else light.weighted(np.full_like(seen, n))
            return PhotonSums(np.minimum(lit, frames * np.float32(n), out=lit), seen * np.float32(n), light)
    some = np.maximum(frames, 1)
    photons = source.response.flux(np.asarray(lit / some, np.float32), some) * frames
    return PhotonSums(np.asarray(np.where(frames > 0, np.maximum(photons, 0), 0), np.float32), seen, light)


@compiled
def add_observations(
    counts: FluxImage, usable: BoolArray, amounts: FluxImage, to_grid: FloatArray, first: int, lit: FluxImage, seen: FluxImage
) -> None:
    """Add the pixels of a sum of frames, (h, w), to the cells that their centres fall into.

    `to_grid` (3, 3) maps pixels of the frame to cells of the whole grid, of which `lit` (H, W) and `seen` (P, H, W) are the
    rows from `first` on. Each usable pixel adds its count to `lit`, and `amounts` (P,), such as the frames in the sum, to
    `seen`.
    """
    height, width = counts.shape
    rows, columns = lit.shape
    present = np.flatnonzero(amounts)
    for y in range(height):
        # Along a row of the frame, the grid's coordinates are quotients of linear functions.
        u0, du = to_grid[0, 1] * y + to_grid[0, 2], to_grid[0, 0]
        v0, dv = to_grid[1, 1] * y + to_grid[1, 2], to_grid[1, 0]
        d0, dd = to_grid[2, 1] * y + to_grid[2, 2], to_grid[2, 0]
        last = width - 1
        ends = v0 / d0 - first, (v0 + dv * last) / (d0 + dd * last) - first
        if max(ends[0], ends[1]) < -0.5 or min(ends[0], ends[1]) > rows - 0.5:
            continue
        for x in range(width):
            per_depth = 1 / (d0 + dd * x)
            column = int(np.floor((u0 + du * x) * per_depth + _UP))
            row = int(np.floor((v0 + dv * x) * per_depth + _UP)) - first
            if 0 <= row < rows and 0 <= column < columns and usable[y, x]:
                lit[row, column] += counts[y, x]
                for p in present:
                    seen[p, row, column] += amounts[p]
