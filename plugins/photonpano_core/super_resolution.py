"""Renderer `super-resolution`: the most probable flux on a grid finer than the sensor.

The photons of frames are sorted into the cells of a canvas: those that an estimate is made from, and those held out. Pixels
whose centres fall into one cell see nearly the same light, whatever their frame: their counts are summed, and so are their
frames. A capture becomes two images, on which each round of an estimate works, not on the frames.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import TypeAlias

import numpy as np

from photonpano import (
    BoolArray,
    Capture,
    FloatArray,
    FluxImage,
    FrameSpan,
    Homography,
    Panorama,
    Source,
    Trajectory,
    capture_of,
)
from photonpano.compiling import compiled
from photonpano.geometry import Canvas, corners, inverse, transform_points, translation
from photonpano.merging import Chunk, LightTerms, LitFrames, chunks_of, divided
from photonpano.photometry import BinaryResponse, BinarySumResponse
from photonpano_core.configs import SuperResolutionConfig
from photonpano_core.fine_grid import STRENGTHS, Observations, coarser, gain_of, pixel_area, rounds_of

Decide = Callable[[str, int | bool, str], None]

_MANY_PIECES = 64  # a span is divided into at least this many chunks, if it has the frames: some of them are held out
Box = tuple[slice, slice]  # rows and columns of an image

logger = logging.getLogger("photonpano.super_resolution")

_BLOCK_PX = 320  # side of the blocks that are estimated one by one; all pixels of a block see with the same area
_HALO_PX = 24  # width of the margin around a block: what lies beyond has no influence that counts
_PROBE_PX = 160  # side of the squares on which frames are held out, without their margins
_PROBES = (0.25, 0.5, 0.75)  # where these squares lie: in the middles of the frames at these shares of the span
_HELD_OUT = 8  # one chunk of frames in 8 is held out
_FEWEST_FRAMES = 1.0  # pixels that fewer frames saw are unknown
_GATHERING = 5  # sorting photons takes about one fifth of the time
# The first round that reaches this fraction of the largest gain is the last: the blur by the area of pixels hides noise of fine
# detail from held-out frames, so that the most likely round is a noisy one.
_ENOUGH = 0.93
_SIGNIFICANT = 2.0  # held-out frames show detail if they are likelier with it than without by this many standard errors


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """Frames of a span along a motion, in chunks."""

    source: Source
    trajectory: Trajectory
    span: FrameSpan
    chunks: Sequence[Chunk]

    def near(self, canvas: Canvas) -> list[Chunk]:
        """Return the chunks whose frames may reach into a canvas."""
        to_canvas = canvas.transform @ np.array([chunk.homography for chunk in self.chunks])
        outlines = transform_points(to_canvas, corners(self.source.info.frame_shape))
        low, high = outlines.min(axis=1) - 1, outlines.max(axis=1) + 1
        inside = (high >= 0).all(axis=1) & (low <= [canvas.width - 1, canvas.height - 1]).all(axis=1)
        return [chunk for chunk, flag in zip(self.chunks, inside, strict=True) if flag]


class SuperResolutionRenderer:
    """Maximises the probability of the flux on the canvas, given the photons and a prior: see `rounds_of`.

    Some frames are held out on three squares, where the estimate of each round predicts them. The first round whose prediction
    is nearly the likeliest is the last one.
    """

    def __init__(self, config: SuperResolutionConfig, threads: int, decide: Decide) -> None:
        """Take the keys of the spec, how many blocks are estimated at once, and what records decisions."""
        self._config, self._threads, self._decide = config, threads, decide
        # A motion, a span, and the number of rounds that held-out frames support for them.
        self._chosen: tuple[Trajectory, FrameSpan, int] | None = None
        self._lock = Lock()

    def render(  # noqa: PLR0917
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Render the frames of a span on a canvas: see `Renderer`."""
        # Frames are sorted by where their pixels lie on the canvas.
        tolerance_px = min(tolerance_px, 0.25 / _scale_of(canvas))
        capture = capture_of(source)
        every = max(1, len(span) // _MANY_PIECES)
        cuts = np.arange(span.start, span.stop, every) if capture.background is None else capture.background.instants
        cuts = np.union1d(cuts, [each.start for each in capture.pieces(span)])
        scan = _Scan(source, trajectory, span, chunks_of(span, trajectory, source.info.frame_shape, tolerance_px, cuts))
        if not scan.near(canvas):
            advance(len(span))
            return Panorama(np.full(canvas.shape, np.nan, np.float32), np.zeros(canvas.shape, np.float32), canvas.transform)
        with _pool(self._threads) as pool:
            with self._lock:
                chosen = self._chosen
                if chosen is None or chosen[0] is not trajectory or chosen[1] != span:
                    chosen = self._chosen = trajectory, span, self._rounds(scan, canvas, pool)
            wide, left, top = _widened(canvas)
            seen = scan.near(wide)
            progress = _Shares(advance, len(span))
            n_frames = sum(len(chunk.span) for chunk in seen)
            sums = sums_on(source, seen, wide, partial(progress.add, 1 / (n_frames * _GATHERING)), pool)
            blank = np.full(wide.shape, np.nan, np.float32)
            whole = Panorama(blank, np.zeros(wide.shape, np.float32), wide.transform)
            tops, lefts = (range(_HALO_PX, side - _HALO_PX, _BLOCK_PX) for side in wide.shape)
            blocks = [(slice(y, y + _BLOCK_PX), slice(x, x + _BLOCK_PX)) for y in tops for x in lefts]
            work = partial(self._fill, whole, sums, scan, chosen[2])
            for _ in pool.map(work, blocks):
                progress.add((1 - 1 / _GATHERING) / len(blocks), 1)
            progress.finish()
        inner = slice(top, top + canvas.height), slice(left, left + canvas.width)
        return Panorama(whole.flux[inner].copy(), whole.weight[inner].copy(), canvas.transform)

    def _fill(self, panorama: Panorama, sums: PhotonSums, scan: _Scan, n_rounds: int, block: Box) -> None:
        """Estimate what frames show of a block of a panorama, if they show anything."""
        part = _seen_part(sums.seen, block)
        if part is None:
            return
        block, inner, around = part
        rows, columns = block
        middle = np.array([(columns.start + columns.stop - 1) / 2, (rows.start + rows.stop - 1) / 2])
        zoom = _zoom_at(middle, panorama.canvas, scan.chunks, scan.source.info.frame_shape)
        observed = self._observations(scan.source, sums.part(around), zoom)
        response = scan.source.response
        trials = response.n if isinstance(response, BinarySumResponse) else 1  # binary frames that a frame is the sum of
        weight = observed.weight()[inner] * np.float32(zoom**2 / trials)
        known = weight >= _FEWEST_FRAMES
        if not known.any():
            return
        flux = rounds_of(observed, n_rounds)[-1][inner] * np.float32(trials)
        panorama.flux[block] = np.where(known, flux, np.float32(np.nan))
        panorama.weight[block] = np.where(known, weight, 0)

    def _observations(self, source: Source, sums: PhotonSums, zoom: float) -> Observations:
        binary = isinstance(source.response, BinaryResponse | BinarySumResponse)
        area = pixel_area(zoom * float(np.sqrt(self._config.fill_factor)))
        return Observations(sums.lit, sums.seen, area, binary, sums.light)

    def _rounds(self, scan: _Scan, canvas: Canvas, pool: ThreadPoolExecutor) -> int:
        """Choose the number of rounds by frames held out, record it, and say whether they show the detail of this scale."""
        scores: list[FloatArray] = []
        detail = np.zeros(2)
        for share in _PROBES:
            probe = _probe(share, scan, canvas)
            near = scan.near(probe)
            held = [chunk for index, chunk in enumerate(near) if index % _HELD_OUT == _HELD_OUT // 2]
            kept = [chunk for index, chunk in enumerate(near) if index % _HELD_OUT != _HELD_OUT // 2]
            if not held:
                continue
            middle = np.array([(probe.width - 1) / 2, (probe.height - 1) / 2])
            zoom = _zoom_at(middle, probe.transform, near, scan.source.info.frame_shape)
            fitted, tested = (
                self._observations(scan.source, sums_on(scan.source, part, probe, lambda _: None, pool), zoom)
                for part in (kept, held)
            )
            inner = slice(_HALO_PX, -_HALO_PX), slice(_HALO_PX, -_HALO_PX)
            results = rounds_of(fitted, len(STRENGTHS))
            likely = [tested.log_likelihood(flux)[inner] for flux in results]
            scores.append(np.array([float(each.sum(dtype=np.float64)) for each in likely]))
            best = int(np.argmax(scores[-1]))
            gain, error = gain_of(likely[best], tested.log_likelihood(coarser(results[best]))[inner])
            detail += gain, error**2
        if not scores:
            return len(STRENGTHS) // 2
        total = np.sum(scores, axis=0)
        gains = total - total[0]
        n_rounds = int(np.argmax(gains >= _ENOUGH * gains.max())) + 1
        listed = ", ".join(f"{each:.0f}" for each in gains)
        self._decide(
            "super_resolution.rounds",
            n_rounds,
            f"of {len(STRENGTHS)}, each with a weaker prior: the first that predicts frames held out nearly as well as the "
            f"best; their log-likelihood by round, relative to the first: {listed}",
        )
        gain, error = float(detail[0]), float(np.sqrt(detail[1]))
        supported = gain > _SIGNIFICANT * error
        scale = _scale_of(canvas)
        found = f"the log-likelihood of frames held out changes by {gain:+.1f} +- {error:.1f}"
        if supported:
            reason = f"with the detail of scale {scale:g} beyond that of {scale / 2:g}, {found}"
        else:
            reason = f"the photons do not support scale {scale:g}: with its detail beyond that of scale {scale / 2:g}, {found}"
            logger.warning(reason)
        self._decide("super_resolution.supported", supported, reason)
        return n_rounds


class _Shares:
    """Reports fractions of the work to `advance` as whole frames."""

    def __init__(self, advance: Callable[[int], None], n_frames: int) -> None:
        self._advance, self._n_frames = advance, n_frames
        self._share, self._done = 0.0, 0

    def add(self, share: float, times: int) -> None:
        self._share += share * times
        done = min(int(self._share * self._n_frames), self._n_frames)
        self._advance(done - self._done)
        self._done = done

    def finish(self) -> None:
        """Add what rounding has left."""
        self._advance(self._n_frames - self._done)
        self._done = self._n_frames


@contextmanager
def _pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Open a pool of threads; an interrupt cancels what has not started."""
    pool = ThreadPoolExecutor(threads, thread_name_prefix="super-resolution")
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _scale_of(canvas: Canvas) -> float:
    return float(np.sqrt(abs(np.linalg.det(canvas.transform[:2, :2]))))


def _widened(canvas: Canvas) -> tuple[Canvas, int, int]:
    """Return a canvas of whole blocks with a margin on all sides, and how far to the left and to the top it is wider.

    Blocks begin at multiples of their side in the reference plane, so that they are the same in every tile.
    """
    first = -np.floor(canvas.transform[:2, 2] / canvas.transform[2, 2]).astype(int)
    left, top = (int(each % _BLOCK_PX) + _HALO_PX for each in first)
    height, width = (
        -(-(before - _HALO_PX + side) // _BLOCK_PX) * _BLOCK_PX + 2 * _HALO_PX
        for before, side in ((top, canvas.height), (left, canvas.width))
    )
    return Canvas(height, width, translation(left, top) @ canvas.transform), left, top


def _seen_part(seen: FluxImage, block: Box) -> tuple[Box, Box, Box] | None:
    """Return the part of a block around which something was seen, its place within the third, and the part with its margin."""
    rows, columns = block
    near = seen[rows.start - _HALO_PX : rows.stop + _HALO_PX, columns.start - _HALO_PX : columns.stop + _HALO_PX] > 0
    found = []
    for axis, side in ((1, rows), (0, columns)):
        at = np.flatnonzero(near.any(axis=axis)) + side.start - _HALO_PX
        if not at.size:
            return None
        # At least a patch of the denoiser.
        start, stop = max(side.start, int(at[0]) - _HALO_PX), min(side.stop, int(at[-1]) + 1 + _HALO_PX)
        if start >= stop:
            return None
        found.append(slice(start, stop))
    part = found[0], found[1]
    inner = slice(_HALO_PX, _HALO_PX + part[0].stop - part[0].start), slice(_HALO_PX, _HALO_PX + part[1].stop - part[1].start)
    around = slice(part[0].start - _HALO_PX, part[0].stop + _HALO_PX), slice(part[1].start - _HALO_PX, part[1].stop + _HALO_PX)
    return part, inner, around


def _probe(share: float, scan: _Scan, canvas: Canvas) -> Canvas:
    """Return a square, with its margin, around the middle of the frame at a share of the span, on pixels of the canvas."""
    instant = scan.span.start + share * (len(scan.span) - 1)
    to_canvas = canvas.transform @ scan.trajectory.at([instant])[0]
    outline = transform_points(to_canvas, corners(scan.source.info.frame_shape))
    # Even sides, so that the detail of a grid half as fine is easily found.
    width, height = (2 * int(min(_PROBE_PX, side) // 2 + _HALO_PX) for side in np.ceil(np.ptp(outline, axis=0)) + 1)
    left, top = np.rint(outline.mean(axis=0) - [width / 2, height / 2])
    return Canvas(height, width, translation(-left, -top) @ canvas.transform)


def _zoom_at(middle: FloatArray, canvas: Homography, chunks: Sequence[Chunk], frame_shape: tuple[int, int]) -> float:
    """Return the pixels of the canvas along a side of a pixel of a frame, on average over the frames that see a place."""
    height, width = frame_shape
    every = chunks[:: max(1, len(chunks) // 256)]
    to_canvas = canvas @ np.array([chunk.homography for chunk in every])
    points = transform_points(inverse(to_canvas), middle[None])[:, 0]
    outside = np.maximum(np.abs(points - [(width - 1) / 2, (height - 1) / 2]) - [width / 2, height / 2], 0).sum(axis=1)
    inside = outside <= outside.min()
    seen, at = to_canvas[inside], points[inside]
    here, right, below = (
        np.array([transform_points(homography, (point + step)[None])[0] for homography, point in zip(seen, at, strict=True)])
        for step in ([0, 0], [1, 0], [0, 1])
    )
    a, b = (right - here).T, (below - here).T
    return float(np.sqrt(np.abs(a[0] * b[1] - a[1] * b[0])).mean())


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


def _add(summed: Sequence[_Summed], to_grid: Sequence[Homography], lit: FluxImage, seen: FluxImage, rows: range) -> None:
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
def add_observations(  # noqa: PLR0917
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
