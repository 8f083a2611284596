"""Warp sums of frames onto a grid and add them up, for virtual exposures and panoramas; and sum frames in large pixels.

A chunk is a run of frames within which the motion stays below a tolerance, so that one warp serves the whole run. In changing
light, frames of one gain are counted together for each pixel of a grid.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from threading import Lock
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.capture import Capture, capture_of, with_background
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.execution.threads import InOrder
from photonpano.geometry import BLOCK_FRAMES, Canvas, inverse, steps_px
from photonpano.merging.warping import Footprint, Grid, Texture, add_warped, average_squares, footprints_of
from photonpano.values import Counts, FloatArray, FluxImage, FrameSpan, Homography, Light, Response


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Frames that are summed before they are warped."""

    span: FrameSpan  # the frames
    # (3, 3), pixels of the frame at the centre of the span to pixels of the reference plane: that instant of the trajectory.
    # The identity where no motion is known.
    homography: Homography


def chunks_of(
    span: FrameSpan, trajectory: Trajectory, frame_shape: tuple[int, int], tolerance_px: float, cuts: ArrayLike = ()
) -> tuple[Chunk, ...]:
    """Split a span so that no corner of a frame moves further than `tolerance_px` within a chunk.

    Args:
        span: the frames to split.
        trajectory: the motion along which they are summed.
        frame_shape: (height, width) of a frame.
        tolerance_px: length of a corner's path, in pixels of a frame, that one warp may ignore. A chunk is warped at its
            centre instant, so that a photon is misplaced by about half of it at most.
        cuts: instants that no chunk contains.
    """
    blocks = [FrameSpan(block.start, min(block.stop + 1, span.stop)) for block in span.blocks(BLOCK_FRAMES)]
    # The motion of each frame in pixels of the frame before.
    steps = [steps_px(trajectory.at(np.arange(block.start, block.stop)), frame_shape).max(axis=-1) for block in blocks]
    path_px = np.cumsum(np.concatenate([[0.0], *steps]))
    starts = span.start + np.flatnonzero(np.diff(np.floor(path_px / tolerance_px), prepend=-1.0))
    inside = np.ceil(np.asarray(cuts, float)).astype(int)
    starts = np.union1d(starts, inside[(span.start < inside) & (inside < span.stop)])
    stops = np.append(starts[1:], span.stop)
    spans = [FrameSpan(start, stop) for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)]
    centres = trajectory.at([chunk.centre for chunk in spans])
    return tuple(Chunk(chunk, homography) for chunk, homography in zip(spans, centres, strict=True))


def clipped(chunks: Sequence[Chunk], span: FrameSpan, trajectory: Trajectory) -> tuple[Chunk, ...]:
    """Return the parts of chunks that lie in a span; the chunks are in order, as `chunks_of` returns them for the trajectory.

    Chunks inside the span are returned as they are, so that overlapping spans share their sums: see `CountsCache`.
    """
    first = bisect_right(chunks, span.start, key=lambda chunk: chunk.span.stop)
    last = bisect_left(chunks, span.stop, key=lambda chunk: chunk.span.start)
    inside = list(chunks[first:last])
    for end in {0, len(inside) - 1}:
        whole = inside[end].span
        part = FrameSpan(max(whole.start, span.start), min(whole.stop, span.stop))
        if part != whole:
            inside[end] = Chunk(part, trajectory.at([part.centre])[0])
    return tuple(inside)


class CountsCache:
    """Caches the sums of frames that overlapping groups share; drops the least recently used. Safe from several threads."""

    def __init__(self, source: Source, capacity_bytes: int) -> None:
        self._capture = capture_of(source)
        height, width = source.info.frame_shape
        self._max_sums = max(1, capacity_bytes // (4 * height * width))
        self._sums: OrderedDict[FrameSpan, Future[Counts]] = OrderedDict()
        self._lock = Lock()

    def __call__(self, span: FrameSpan) -> Counts:
        """Return the sum of the frames of a span, read-only: see `Capture.chunk`.

        If several threads ask for one span at once, the first computes it and the others wait.
        """
        with self._lock:
            cached = self._sums.get(span)
            if cached is not None:
                self._sums.move_to_end(span)
            else:
                future = self._sums[span] = Future()
                while len(self._sums) > self._max_sums:
                    self._sums.popitem(last=False)
        if cached is not None:
            return cached.result()
        try:
            counts = self._capture.chunk(span)
            counts.flags.writeable = False
        except BaseException as error:
            future.set_exception(error)
            raise
        future.set_result(counts)
        return counts


_ROUNDS = 8  # steps that solve for the flux of bright pixels in frames of different gains. Each at least halves the error
_ACCURACY = 1e-4  # the steps end when no flux changes by more than this share
_FAR = 1e4  # a place on a map of amplitudes that lies beyond its end, in px
_GRID_PX = 4  # between pixels at which places on a sphere are computed
_SEEN = 1e-3  # sums of less than this many frames are rounding errors


def bytes_of_light(source: Source) -> int:
    """Return the memory that the light of a capture takes for each pixel of a grid; 0 in steady light."""
    light = capture_of(source).light
    if light is None:
        return 0
    # Each coverage has two images; frames and gains, and their quotient, are three more for a class.
    return 4 * (int(light.classes().max()) + 1) * (2 * (2 + len(light.waves)) + 3)


@dataclass(frozen=True, slots=True, eq=False)
class LitFrames:
    """Frames and gains of the pixels of a grid, by the class of their light."""

    frames: FluxImage  # (C, H, W) float32, number of frames of each class in which a pixel was seen
    gains: FluxImage  # (C, H, W) float32, sum of the gains of the pixel in these frames

    @property
    def weight(self) -> FluxImage:
        """Sum of the gains of each pixel: (H, W), frames of mean light."""
        return np.asarray(self.gains.sum(axis=0), np.float32)

    def flux(self, counts: FluxImage, response: Response) -> FluxImage:
        """Return the flux of each pixel that explains its counts: `counts = sum_c frames_c mean_count(gain_c flux)`.

        Frames of one gain, and linear responses, need one step. Saturated pixels get a flux that is finite, and too small.
        """
        frames = np.maximum(self.frames.sum(axis=0), np.float32(1))
        total = np.maximum(self.weight, np.float32(_SEEN))
        # Subtraction of dark counts can leave a negative sum by chance.
        found = response.flux(np.asarray(np.maximum(counts, 0) / frames, np.float32), frames)
        flux = np.asarray(found * frames / total, np.float32)
        if len(self.frames) == 1:
            return flux
        gains = np.divide(self.gains, self.frames, out=np.zeros_like(self.gains), where=self.frames > _SEEN)
        for _ in range(_ROUNDS):
            mean = np.zeros_like(flux)
            for each, gain in zip(self.frames, gains, strict=True):
                mean += each / frames * response.mean_count(np.asarray(gain * flux, np.float32))
            seen = response.flux(mean, frames)
            better = np.where(np.abs(seen) > 1e-9, flux * found / np.where(np.abs(seen) > 1e-9, seen, 1), flux)
            change = np.abs(better - flux) > _ACCURACY * np.abs(flux)
            flux = np.asarray(better, np.float32)
            if not change.any():
                break
        return flux

    def part(self, box: tuple[slice, slice]) -> LitFrames:
        """Return copies of some rows and columns."""
        return LitFrames(self.frames[:, *box].copy(), self.gains[:, *box].copy())

    def weighted(self, by: FluxImage) -> LitFrames:
        """Return these frames with a weight for each pixel, (H, W)."""
        return LitFrames(self.frames * by, self.gains * by)


@dataclass(frozen=True, slots=True, eq=False)
class LightTerms:
    """What chunks of frames add to the coverages of a grid: for each class of light, frames and the terms of their gains."""

    light: Light  # of the capture
    classes: NDArray[np.int64]  # (T,) class of each frame
    present: tuple[int, ...]  # the classes of the frames that are summed, in order

    @classmethod
    def of(cls, light: Light, spans: Sequence[FrameSpan]) -> LightTerms:
        """Prepare to sum the frames of spans."""
        classes = light.classes()
        parts = [classes[span.start : span.stop] for span in spans]
        return cls(light, classes, tuple(np.unique(np.concatenate(parts)).tolist()) if parts else (0,))

    @property
    def number(self) -> int:
        """How many coverages there are."""
        return len(self.present) * (2 + len(self.light.waves))

    def amounts(self, span: FrameSpan) -> FloatArray:
        """Return what the frames of a span add to each coverage: (number,)."""
        terms = self.light.terms(span)
        values = np.concatenate([np.ones_like(terms[:1]), terms])
        of_class = self.classes[span.start : span.stop] == np.array(self.present)[:, None]
        return np.asarray((of_class.astype(float) @ values.T).ravel())

    def lit_frames(self, coverages: FluxImage, canvas: Canvas) -> LitFrames:
        """Return the frames and gains of each pixel, from (number, H, W) coverages of a canvas."""
        by_class = coverages.reshape(len(self.present), -1, *canvas.shape)
        gains = by_class[:, 1].copy()
        for index, image in enumerate(amplitudes_on(self.light, canvas)):
            gains += image * by_class[:, 2 + index]
        return LitFrames(np.ascontiguousarray(by_class[:, 0]), np.maximum(gains, 0))


def amplitudes_on(light: Light, canvas: Canvas) -> list[FluxImage]:
    """Return the amplitudes of the lamps at the pixels of a canvas, (H, W) for each map; beyond its end, those at the end."""
    _, height, width = light.maps.shape
    if light.camera_matrix is None and canvas.planar:
        flags, onto = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, light.to_map @ inverse(canvas.transform)
        size = canvas.width, canvas.height
        return [
            np.asarray(cv2.warpPerspective(each, onto, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))
            for each in light.maps
        ]
    projection = "planar" if light.camera_matrix is None else "spherical"
    maps = Canvas(height, width, light.to_map, projection, light.camera_matrix)
    # The squares of maps are larger than this grid, whose places take as long as a whole merge at each pixel.
    rows, columns = (np.arange(0, length + _GRID_PX, _GRID_PX, dtype=float) for length in canvas.shape)
    grid = canvas.on_plane(np.stack(np.meshgrid(columns, rows), axis=-1)) @ maps.plane_to_rays.T
    x, y = np.moveaxis(np.clip(np.nan_to_num(maps.pixels(grid), nan=_FAR), -1, _FAR).astype(np.float32), -1, 0)
    coarse = [cv2.remap(each, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for each in light.maps]
    finer = np.diag([_GRID_PX, _GRID_PX, 1.0])
    return [np.asarray(cv2.warpPerspective(each, finer, (canvas.width, canvas.height))) for each in coarse]


def gain_image(light: Light, span: FrameSpan, to_plane: Homography, shape: tuple[int, int]) -> FluxImage:
    """Return the mean gain of the pixels of a frame over a span: (H, W); see `amplitudes_on`."""
    gain, *waves = light.terms(span).mean(axis=1)
    image = np.full(shape, gain, np.float32)
    for wave, amplitude in zip(waves, amplitudes_on(light, Canvas(*shape, inverse(to_plane))), strict=True):
        image += np.float32(wave) * amplitude
    return np.maximum(image, np.float32(0))


_RUN = 64  # chunks that are summed on a part of the grid of their own. It does not depend on the threads, for sums are rounded
_BLOCK = 4096  # chunks whose footprints are known at a time
# Pixels are binned until the shorter side has about 64 of them, which lowers the noise and keeps shifts measurable.
_SIDE_PX = 64
_MIN_WEIGHT = 1.0  # pixels with less weight than this, in frames, are unknown

_Visible = Sequence[tuple[Chunk, Footprint]]


@dataclass(frozen=True, slots=True, eq=False)
class PhotonSum:
    """Warped counts, and the number of frames in which each pixel was seen."""

    counts: FluxImage  # (H, W) float32
    weight: FluxImage  # (H, W) float32, in frames; in changing light, the sum of their gains: in frames of mean light
    lit: LitFrames | None = None  # frames and gains by the class of their light; None in steady light

    def estimate(self, response: Response) -> tuple[FluxImage, FluxImage]:
        """Return the maximum-likelihood flux of each pixel (paper, equation 3) and its weight: (H, W) float32 each.

        Where the weight is below one frame, it is 0, and the flux NaN.
        """
        unknown = self.weight < _MIN_WEIGHT
        if self.lit is not None:
            flux, weight = self.lit.flux(self.counts, response), self.weight.copy()
            flux[unknown], weight[unknown] = np.nan, 0
            return flux, weight
        seen = np.asarray(np.maximum(self.weight, _MIN_WEIGHT), dtype=np.float32)
        # Subtraction of dark counts can leave a negative sum by chance.
        mean = np.asarray(np.maximum(self.counts, 0) / seen, dtype=np.float32)
        flux, weight = response.flux(mean, seen), self.weight.copy()
        flux[unknown], weight[unknown] = np.nan, 0
        return flux, weight


def accumulate(  # noqa: PLR0917
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
        counts, coverages = _sum_on(capture, terms, counts_of or capture.chunk, canvas=canvas, visible=visible, advance=advance)
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
    counts, coverages = _sum_on(
        source, terms, source.chunk, canvas=part, visible=_visible(source, chunks, part), advance=lambda _: None
    )
    return _Part((slice(top, bottom), slice(left, right)), counts, coverages, _frames(chunks))


def _sum_on(
    source: Capture,
    terms: LightTerms | None,
    counts_of: Callable[[FrameSpan], Counts],
    *,
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


def binned_mean(source: Source, span: FrameSpan, binning: int | None = None) -> FluxImage:
    """Return the mean count per frame of a span in binned pixels, (h, w); NaN where no pixel is valid.

    The `binning` is that of `binning_of`, unless it is given.
    """
    capture = with_background(source, None)
    if len(pieces := capture.pieces(span)) > 1:
        means = np.array([binned_mean(source, each, binning) for each in pieces])
        frames = np.isfinite(means) * np.array([len(each) for each in pieces], np.float32)[:, None, None]
        n_frames = frames.sum(axis=0)
        mean = (np.nan_to_num(means) * frames).sum(axis=0) / np.maximum(n_frames, 1)
        return np.where(n_frames > 0, mean, np.float32(np.nan))
    binning = binning or binning_of(source)
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
