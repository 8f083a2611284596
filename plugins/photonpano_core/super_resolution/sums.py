"""Sort the photons of a capture into the cells of a canvas: those that an estimate is made from, and those held out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from photonpano import BoolArray, FluxImage, FrameSpan, Homography, LinearlyCorrectedSource, Source, Trajectory
from photonpano.geometry import Canvas, apply, corners
from photonpano.merging import Chunk, chunks_of, divided
from photonpano.photometry import BinaryResponse, BinarySumResponse
from photonpano_core.super_resolution.observing import add_observations

_BATCH = 16
"""Chunks that are summed before they are added to the grid."""
_PART_ROWS = 64
"""Rows of the grid, about, that a thread adds to at a time."""
_MANY_PIECES = 64
"""A span is divided into at least this many chunks, if it has the frames: some of them are held out."""


def pieces_of(span: FrameSpan, trajectory: Trajectory, frame_shape: tuple[int, int], tolerance_px: float) -> list[Chunk]:
    """Divide a span as `chunks_of` does; long chunks, of a camera that hardly moves, are divided further."""
    longest = max(1, len(span) // _MANY_PIECES)
    pieces = []
    for chunk in chunks_of(span, trajectory, frame_shape, tolerance_px):
        if len(chunk.span) <= longest:
            pieces.append(chunk)
        else:
            pieces += [Chunk(part, chunk.homography) for part in chunk.span.blocks(longest)]
    return pieces


def visible(chunks: Sequence[Chunk], canvas: Canvas, frame_shape: tuple[int, int]) -> list[Chunk]:
    """Return the chunks whose frames may reach into a canvas."""
    if not chunks:
        return []
    outlines = apply(canvas.transform @ np.array([chunk.homography for chunk in chunks]), corners(frame_shape))
    low, high = outlines.min(axis=1) - 1, outlines.max(axis=1) + 1
    inside = (high >= 0).all(axis=1) & (low <= [canvas.width - 1, canvas.height - 1]).all(axis=1)
    return [chunk for chunk, flag in zip(chunks, inside, strict=True) if flag]


def sums_on(
    source: Source, chunks: Sequence[Chunk], canvas: Canvas, advance: Callable[[int], None], pool: Executor
) -> tuple[FluxImage, FluxImage]:
    """Sum the counts and the frames of the pixels whose centres fall into each cell of a canvas.

    Returns:
        Counts and frames, (H, W) float32 each. For a camera that does not count single photons, the counts are photons; for
        sums of binary frames, the frames are binary ones.
    """
    lit, seen = np.zeros(canvas.shape, np.float32), np.zeros(canvas.shape, np.float32)
    usable = np.ascontiguousarray(source.valid)
    parts = divided(canvas.height, max(1, canvas.height // _PART_ROWS))
    adding: Iterable[None] = ()
    for first in range(0, len(chunks), _BATCH):
        batch = chunks[first : first + _BATCH]
        summed = list(pool.map(partial(_summed, source), batch))
        deque(adding, maxlen=0)
        to_grid = [np.ascontiguousarray(canvas.transform @ chunk.homography) for chunk in batch]
        adding = pool.map(partial(_add, batch, summed, to_grid, usable, lit, seen), parts)
        for chunk in batch:
            advance(len(chunk.span))
    deque(adding, maxlen=0)
    return _photons(source, lit, seen)


def _summed(source: Source, chunk: Chunk) -> NDArray[np.float32]:
    counts = source.counts(chunk.span)
    if isinstance(source, LinearlyCorrectedSource):
        return np.ascontiguousarray(source.corrected(counts, len(chunk.span)), np.float32)
    return np.ascontiguousarray(counts, np.float32)


def _add(
    chunks: Sequence[Chunk],
    summed: Sequence[NDArray[np.float32]],
    to_grid: Sequence[Homography],
    usable: BoolArray,
    lit: FluxImage,
    seen: FluxImage,
    rows: range,
) -> None:
    part = slice(rows.start, rows.stop)
    for chunk, counts, homography in zip(chunks, summed, to_grid, strict=True):
        add_observations(counts, usable, float(len(chunk.span)), homography, rows.start, lit[part], seen[part])


def _photons(source: Source, lit: FluxImage, seen: FluxImage) -> tuple[FluxImage, FluxImage]:
    # Subtraction of dark counts can leave a negative sum by chance.
    lit = np.maximum(lit, 0, out=lit)
    match source.response:
        case BinaryResponse():
            return np.minimum(lit, seen, out=lit), seen
        case BinarySumResponse(n):
            seen *= np.float32(n)
            return np.minimum(lit, seen, out=lit), seen
    frames = np.maximum(seen, 1)
    photons = source.response.flux(np.asarray(lit / frames, np.float32), frames) * seen
    return np.asarray(np.where(seen > 0, np.maximum(photons, 0), 0), np.float32), seen
