"""Warp sums of frames onto a grid and add them up, for virtual exposures and panoramas; and sum frames in large pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, before, capture_of
from photonpano.contracts.protocols import Source
from photonpano.execution.threads import InOrder
from photonpano.geometry import Canvas
from photonpano.merging.chunks import Chunk
from photonpano.merging.footprints import Footprint, footprints_of
from photonpano.merging.light import LightTerms, LitFrames
from photonpano.merging.warping import Grid, Texture, add_warped, average_squares
from photonpano.values import Counts, FluxImage, FrameSpan, Homography, Response

_RUN = 64  # chunks that are summed on a part of the grid of their own. It does not depend on the threads, for sums are rounded
_BLOCK = 4096  # chunks whose footprints are known at a time
# Pixels are binned until the shorter side has about 64 of them, which lowers the noise and keeps shifts measurable.
_SIDE_PX = 64
MIN_WEIGHT = 1.0  # pixels with less weight than this, in frames, are unknown

_Visible = Sequence[tuple[Chunk, Footprint]]


@dataclass(frozen=True, slots=True, eq=False)
class PhotonSum:
    """Warped counts, and the number of frames in which each pixel was seen."""

    counts: FluxImage  # (H, W) float32
    weight: FluxImage  # (H, W) float32, in frames; in changing light, the sum of their gains: in frames of mean light
    lit: LitFrames | None = None  # frames and gains by the class of their light; None in steady light

    def estimate(self, response: Response) -> tuple[FluxImage, FluxImage]:
        """Return the maximum-likelihood flux of each pixel (paper, equation 3) and its weight.

        Returns:
            Flux, (H, W) float32, NaN where the weight is below one frame; weight, (H, W) float32, 0 there.
        """
        unknown = self.weight < MIN_WEIGHT
        if self.lit is not None:
            flux, weight = self.lit.flux(self.counts, response), self.weight.copy()
            flux[unknown], weight[unknown] = np.nan, 0
            return flux, weight
        seen = np.asarray(np.maximum(self.weight, MIN_WEIGHT), dtype=np.float32)
        # Subtraction of dark counts can leave a negative sum by chance.
        mean = np.asarray(np.maximum(self.counts, 0) / seen, dtype=np.float32)
        flux, weight = response.flux(mean, seen), self.weight.copy()
        flux[unknown], weight[unknown] = np.nan, 0
        return flux, weight


def accumulate(
    source: Source,
    chunks: Sequence[Chunk],
    onto: Homography | Canvas,
    shape: tuple[int, int],
    advance: Callable[[int], None] | None = None,
    in_order: InOrder | None = None,
    counts_of: Callable[[FrameSpan], Counts] | None = None,
) -> PhotonSum:
    """Sum the frames of chunks on a grid, each chunk warped once.

    Convention:
        Points are (x, y), integers are pixel centres. Counts and weights are interpolated bilinearly, both in the same way, so
        that their quotient is not biased at masks and borders.

    Args:
        source: the capture. Pixels outside of its mask are left out; sums are corrected, pixels are weighted, and so are frames
            by the gains of their light. Frames are warped through the lens of its camera.
        chunks: frames, with their maps to the reference plane.
        onto: (3, 3), pixels of the reference plane to pixels of the grid; or a canvas of any projection, which is the grid.
        shape: (height, width) of the grid.
        advance: called with numbers of frames that are done; first with that of all chunks off the grid.
        in_order: sums runs of chunks at once, each on the part of the grid that it covers, and yields the sums in order. They
            do not depend on how many are under way. By default, there is one run.
        counts_of: returns the uncorrected sum of a span, such as a `CountsCache`; `chunk` of the capture by default.
    """
    advance = advance or (lambda _: None)
    capture = capture_of(source)
    terms = None if capture.light is None else LightTerms.of(capture.light, [chunk.span for chunk in chunks])
    canvas = onto if isinstance(onto, Canvas) else Canvas(*shape, onto)
    if in_order is None:
        visible = _visible(capture, chunks, canvas)
        if off_grid := _frames(chunks) - _frames([chunk for chunk, _ in visible]):
            advance(off_grid)
        counts, coverages = _sum_on(capture, terms, counts_of or capture.chunk, canvas, visible, advance)
    else:
        number = 1 if terms is None else terms.number
        counts, coverages = np.zeros(shape, np.float32), np.zeros((number, *shape), np.float32)
        # Footprints take more memory than chunks, and each run finds its own.
        blocks = (chunks[first : first + _BLOCK] for first in range(0, len(chunks), _BLOCK))
        shown = [chunk for block in blocks for chunk, _ in _visible(capture, block, canvas)]
        if off_grid := _frames(chunks) - _frames(shown):
            advance(off_grid)
        runs = (shown[first : first + _RUN] for first in range(0, len(shown), _RUN))
        for part in in_order(partial(_sum_of_run, capture, terms, canvas), runs):
            counts[part.box] += part.counts
            coverages[:, *part.box] += part.coverages
            advance(part.n_frames)
    if terms is None:
        return PhotonSum(counts, coverages[0])
    lit = terms.lit_frames(coverages, canvas)
    return PhotonSum(counts, lit.weight, lit)


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """The sum of a run of chunks on the part of the grid that it covers."""

    box: tuple[slice, slice]  # rows and columns of that part
    counts: FluxImage  # (h, w) float32
    coverages: FluxImage  # (P, h, w) float32
    n_frames: int  # of the run


def _frames(chunks: Sequence[Chunk]) -> int:
    return sum(len(chunk.span) for chunk in chunks)


def _visible(source: Capture, chunks: Sequence[Chunk], canvas: Canvas) -> _Visible:
    """Return the chunks that lie on a canvas, with their footprints."""
    homographies = np.array([chunk.homography for chunk in chunks]).reshape(-1, 3, 3)
    footprints = footprints_of(canvas, source.camera, homographies, source.info.frame_shape)
    return [(chunk, at) for chunk, at in zip(chunks, footprints, strict=True) if at.rows and at.columns]


def _sum_of_run(source: Capture, terms: LightTerms | None, canvas: Canvas, chunks: Sequence[Chunk]) -> _Part:
    footprints = [at for _, at in _visible(source, chunks, canvas)]
    top, bottom = min(at.rows.start for at in footprints), max(at.rows.stop for at in footprints)
    columns = [each for at in footprints for each in at.columns]
    left, right = min(each.start for each in columns), max(each.stop for each in columns)
    part = canvas.part(left, top, bottom - top, right - left)
    counts, coverages = _sum_on(source, terms, source.chunk, part, _visible(source, chunks, part), lambda _: None)
    return _Part((slice(top, bottom), slice(left, right)), counts, coverages, _frames(chunks))


def _sum_on(
    source: Capture,
    terms: LightTerms | None,
    counts_of: Callable[[FrameSpan], Counts],
    canvas: Canvas,
    visible: _Visible,
    advance: Callable[[int], None],
) -> tuple[FluxImage, FluxImage]:
    """Return the counts and the coverages of a canvas: (H, W) and (P, H, W)."""
    masked: NDArray[np.float32] | NDArray[np.uint8] | None = weights_of(source)
    corrected = source.corrected if source.corrects_sums else None
    if masked is not None and corrected is None and source.weight is None:
        masked = masked.astype(np.uint8)  # sums in bytes stay in bytes
    grid, seen_by = Grid.zeros(canvas, 1 if terms is None else terms.number), _Seen(source.info.frame_shape, masked)
    for chunk, footprint in visible:
        shown = source.shown_pixels(chunk.span)
        weight = masked if shown is None else shown if masked is None else masked * shown
        amounts = np.array([float(len(chunk.span))]) if terms is None else terms.amounts(chunk.span)
        raw = counts_of(chunk.span)
        counts: FluxImage | Counts = raw if corrected is None else corrected(raw, len(chunk.span))
        image = Texture.of(average_squares(counts if weight is None else counts * weight, footprint.shrink))
        seen = seen_by(footprint.shrink, image.texels.dtype, None if shown is None else weight)
        add_warped(image, seen, amounts, footprint, grid)
        advance(len(chunk.span))
    return grid.total, grid.coverages


def weights_of(source: Source) -> FluxImage | None:
    """Return the weight of a frame of each pixel, 0 for a masked one: (H, W); None if it is 1 for all."""
    capture = capture_of(source)
    if capture.weight is not None:
        return np.where(capture.valid, capture.weight, np.float32(0))
    return None if capture.valid.all() else capture.valid.astype(np.float32)


class _Seen:
    """The share of each pixel that is seen, averaged over squares: the same for all chunks."""

    def __init__(self, frame_shape: tuple[int, int], masked: NDArray[np.float32] | NDArray[np.uint8] | None) -> None:
        self._frame_shape, self._masked = frame_shape, masked
        self._textures: dict[tuple[int, object], Texture | None] = {}

    def __call__(self, shrink: int, texel: np.dtype[Any], share: FluxImage | NDArray[np.uint8] | None = None) -> Texture | None:
        """Return it for squares of `shrink` pixels a side, in texels of the same kind as the image; None if it is 1 for all.

        `share` (H, W) is that of a chunk in which it is not what it is for all others.
        """
        if share is not None:
            return _texture(share, shrink, texel)
        if (shrink, texel) not in self._textures:
            whole = self._masked is None and not any(side % shrink for side in self._frame_shape)
            seen = np.ones(self._frame_shape, np.float32) if self._masked is None else self._masked
            self._textures[shrink, texel] = None if whole else _texture(seen, shrink, texel)
        return self._textures[shrink, texel]


def _texture(share: FluxImage | NDArray[np.uint8], shrink: int, texel: np.dtype[Any]) -> Texture:
    like = share.astype(np.uint8) if texel == np.uint32 else share.astype(np.float32)
    return Texture.of(average_squares(like, shrink))


def divided(length: int, parts: int) -> list[range]:
    """Divide `range(length)` into parts of about equal length, each of 1 or more."""
    bounds = [length * part // parts for part in range(parts + 1)]
    return [range(start, stop) for start, stop in pairwise(bounds) if start < stop]


def binning_of(source: Source) -> int:
    """Return the side of a binned pixel, in px."""
    return max(1, min(source.info.frame_shape) // _SIDE_PX)


def binned_mean(source: Source, span: FrameSpan) -> FluxImage:
    """Return the mean count per frame of a span in binned pixels, (h, w); NaN where no pixel is valid."""
    capture = before(source, None)
    if len(pieces := capture.pieces(span)) > 1:
        means = np.array([binned_mean(source, each) for each in pieces])
        frames = np.isfinite(means) * np.array([len(each) for each in pieces], np.float32)[:, None, None]
        n_frames = frames.sum(axis=0)
        mean = (np.nan_to_num(means) * frames).sum(axis=0) / np.maximum(n_frames, 1)
        return np.where(n_frames > 0, mean, np.float32(np.nan))
    binning = binning_of(source)
    height, width = (side // binning * binning for side in source.info.frame_shape)
    size = (width // binning, height // binning)
    counts = np.asarray(capture.corrected(capture.chunk(span), len(span)), np.float32)[:height, :width]
    weights = weights_of(capture.masked_in(span))
    if weights is None:
        return np.asarray(cv2.resize(counts, size, interpolation=cv2.INTER_AREA) / np.float32(len(span)), np.float32)
    valid = weights[:height, :width]
    share, summed = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (valid, counts * valid))
    mean = np.full(share.shape, np.nan, dtype=np.float32)
    np.divide(summed, share * len(span), out=mean, where=share > 0)
    return mean
