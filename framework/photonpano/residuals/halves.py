"""What the photons say of a motion: at each cut in time, the frames before it against the frames after it.

Both halves are merged along the motion, each in two parts whose frames alternate. The noise of the four pictures is
independent, so that products of their gradients are unbiased by it: those of the parts of a half, and those of the halves.
Short stretches are compared with all other frames in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import cv2
import numpy as np

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.geometry import Canvas, corners, rescaling, transform_points
from photonpano.merging.canvas_noise import CanvasNoise
from photonpano.merging.colour import channels_of, in_colours
from photonpano.merging.panorama import MergeRenderer
from photonpano.merging.warping import footprints_of
from photonpano.motion.frame_motion import FrameMotion
from photonpano.photometry import frame_variance
from photonpano.residuals.detail import Detail, detail_of
from photonpano.values import BoolArray, FloatArray, FluxImage, FrameSpan, Panorama, Response

_CUTS = 32
_TOLERANCE_PX = 1.0  # motion within which frames are summed: pictures are smoothed by more
# Standard deviations of the Gaussian that smooths the pictures, the first that shows how they are tied: the finest structure is
# mostly noise.
_BLURS_PX = 1.0, 2.0, 4.0
_MARGIN_PX = 4  # around the places of frames that were looked at, for those between them
_FEWEST_FRAMES = 4  # of a block
_LEAST_LIGHT = 0.5  # of each picture, in frames of the mean light that saw a pixel: where the light falls, frames count less
_MOST_PIXELS = 4e6  # of the canvas; a larger one is reduced
_PHASES = 1000  # instants at which it is looked where frames lie on the grid of the sensor
_SAMPLED = 5  # frames of a block at which it is looked where they lie
_SQUARE_PX = 16  # squares whose noise is independent, for each pixel by which pictures are smoothed
_DARKEST = 1e-4  # least flux of which the noise is taken
_INTERPOLATED = 0.001  # what coherence lacks by interpolation alone
_ERRORS = 2.0  # standard errors that are taken off the information


@dataclass(frozen=True, slots=True, eq=False)
class Agreements:
    """How the merges of two sets of frames agree, for each of C pairs of such sets."""

    firsts: FloatArray  # (C,) first frame of the later set, or of a stretch that is compared with all other frames
    # (C,) correlation of the gradients of both without their noise: 1 if the motion is right, and nothing else changes; NaN
    # where they show too little in common
    coherence: FloatArray
    std_coherence: FloatArray  # (C,) by photon noise
    # (C, 2) errors of the shift of one against the other that photon noise lets expect, in px of a frame: along the direction
    # that is known best, and least; half of the longer side of a frame where nothing is known
    std_px: FloatArray
    # (C,) of the direction that is known least, from x towards y on the panorama, 0 to 180; NaN where no place was seen by both
    angles_deg: FloatArray

    @classmethod
    def of(cls, firsts: Sequence[int], found: Sequence[_Agreement], scale: float) -> Agreements:
        """Gather what was found of each pair, on a canvas of so many px for one of a frame."""
        columns = [np.array(column, dtype=np.float64) for column in zip(*found, strict=True)] or [np.zeros(0)] * 4
        coherence, std_coherence, std_px, angles = columns
        return cls(np.array(firsts, dtype=np.float64), coherence, std_coherence, std_px.reshape(-1, 2) / scale, angles)


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """How the frames of a capture agree with each other."""

    cuts: Agreements  # the frames before each cut, and those after it
    stretches: Agreements  # each of the stretches into which the capture is divided, and all frames that are not in it
    detail: Detail | None = None  # that the first and the last frames at each place have in common; None where there is no cut

    @classmethod
    def none(cls) -> Halves:
        """Return those of a capture that is too short for a cut."""
        nothing = Agreements.of([], [], 1)
        return cls(nothing, nothing)

    @property
    def disagreement(self) -> float:
        """By how many standard errors coherence is below 1: the median over the cuts at which it is known."""
        return float(np.nanmedian((1 - self.cuts.coherence) / np.hypot(self.cuts.std_coherence, _INTERPOLATED)))

    def tied_px(self, located: BoolArray) -> FloatArray:
        """Return how far frames may lie beside others to which they are tied weakly: (T,), given which are located.

        Of a displacement across a cut, the best alignment of the planes gives each side the share of the frames of the other.
        A path that returns crosses each cut more than once: there, a stretch that is tied to nothing shows by itself.
        """
        frames, number, cuts = np.arange(len(located)), np.cumsum(located), self.cuts.firsts
        earlier = number[cuts.astype(int) - 1] / max(int(number[-1]), 1)
        shares = np.where(frames[:, None] < cuts, 1 - earlier, earlier)
        across_px = (shares * self.cuts.std_px[:, 1]).max(axis=1, initial=0.0)
        if not len(self.stretches.firsts):
            return np.asarray(across_px)
        stretch = np.searchsorted(self.stretches.firsts, frames, side="right").clip(1) - 1
        # The noise of any short stretch is in the expected error of its exposures.
        seen, alone_px2 = np.isfinite(self.stretches.angles_deg), self.stretches.std_px[:, 1] ** 2
        beyond_px = np.where(seen, np.sqrt(np.maximum(alone_px2 - np.median(alone_px2), 0)), 0)
        return np.asarray(np.maximum(across_px, beyond_px[stretch]))


class _Block(NamedTuple):
    """The picture of some frames on a part of the canvas, as sums over frames: (h, w, C) each."""

    part: tuple[slice, slice]
    lit: FluxImage  # flux times weight
    weight: FluxImage  # in frames


class _Agreement(NamedTuple):
    """How two sets of frames agree: what `Agreements` have of one pair."""

    coherence: float
    std_coherence: float
    std_px: tuple[float, float]  # in px of the canvas
    angle_deg: float


def halves_of(source: Source, motion: FrameMotion, canvas: Canvas, context: Context) -> Halves:
    """Compare the halves of a capture along a motion across up to 32 cuts, and 33 stretches with all others, on any canvas."""
    canvas = reduced(canvas, _MOST_PIXELS)
    spans = _alternating(motion.span, channels_of(source))
    if len(spans) < 4:
        return Halves.none()
    blocks = _blocks(source, motion, spans, canvas=canvas, tolerance_px=_TOLERANCE_PX, context=context)
    scale = canvas.scale
    widest_px = max(motion.frame_shape) / 2 * scale
    # Of the two parts of the first half, and of the second: flux times weight, and weight.
    sums = np.zeros((4, 2, *canvas.shape, channels_of(source)), np.float32)
    for index, block in enumerate(blocks):
        _add(sums[2 + index % 2], block, 1)
    detail = detail_between(_in_time(blocks, sums.shape[2:]), source, motion, canvas)
    pairs = list(zip(blocks[::2], blocks[1::2], strict=True))
    compared = partial(_compared, response=source.response, widest_px=widest_px)
    of_stretches = [compared(_beside(pair, sums[2:])) for pair in pairs]
    of_cuts = []
    for pair in pairs[:-1]:
        for part, block in enumerate(pair):
            _add(sums[part], block, 1)
            _add(sums[2 + part], block, -1)
        of_cuts.append(compared(sums))
    starts = [each.start for each in spans[::2]]
    return Halves(Agreements.of(starts[1:], of_cuts, scale), Agreements.of(starts, of_stretches, scale), detail)


def _alternating(span: FrameSpan, n_colours: int) -> list[FrameSpan]:
    """Divide a span into an even number of blocks, 66 at most, which alternate between the parts of a half."""
    number = 2 * min(_CUTS + 1, len(span) // (2 * _FEWEST_FRAMES * n_colours))  # a pixel has one colour in a frame
    starts = np.linspace(span.start, span.stop, number + 1).round().astype(int).tolist()
    return [FrameSpan(*ends) for ends in pairwise(starts)] if number else []


def halves_in_time(source: Source, motion: FrameMotion, canvas: Canvas, tolerance_px: float, context: Context) -> FluxImage:
    """Merge the first and the last half of the frames that saw each place: (2, 2, H, W, C) sums of flux and weight."""
    spans = _alternating(motion.span, channels_of(source)) or [motion.span]
    blocks = _blocks(source, motion, spans, canvas=canvas, tolerance_px=tolerance_px, context=context)
    return _in_time(blocks, (*canvas.shape, channels_of(source)))


def _in_time(blocks: Sequence[_Block], shape: tuple[int, ...]) -> FluxImage:
    """Add blocks up to two halves of the frames that saw each place.

    Where the camera moves, other pixels show a place in the last half, and motion that is wrong displaces it. Even and odd
    frames would share such errors, and what the grid of the sensor makes of the scene.
    """
    total, seen, sums = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros((2, 2, *shape), np.float32)
    for block in blocks:
        total[block.part] += block.weight
    for block in blocks:
        early = seen[block.part] + block.weight / 2 < total[block.part] / 2
        for half, own in zip(sums, (early, ~early), strict=True):
            _add(half, block._replace(lit=block.lit * own, weight=block.weight * own), 1)
        seen[block.part] += block.weight
    return sums


def detail_between(sums: FluxImage, source: Source, motion: FrameMotion, canvas: Canvas) -> Detail:
    """Find the detail that two halves share, given their (2, 2, H, W, C) sums of flux and weight on a canvas."""
    lit, weight = sums[:, 0], np.maximum(sums[:, 1], np.float32(1e-6))
    seen, (first, last), frames = np.asarray((weight >= _LEAST_LIGHT).all(axis=0)), lit / weight, weight.sum(axis=0)
    mean, variance = lit.sum(axis=0) / frames, np.zeros_like(frames)
    for index, colour in enumerate(capture_of(source).colours().values() or [source]):
        noise = CanvasNoise.of(colour, motion.trajectory, motion.span, canvas)
        variance[..., index] = noise.std(mean[..., index], frames[..., index]) ** 2
    variance *= frames * (1 / weight).sum(axis=0)
    ratio = float(np.sqrt(np.mean((first - last)[seen] ** 2 / variance[seen]))) if seen.any() else np.nan
    in_view = max(1, round(len(motion.span) * seen.sum() / max(frames[seen].sum(), 1)))  # times that a place is in view
    instants = np.linspace(motion.span.start, motion.span.stop - 1, min(len(motion.span), _PHASES)).round()
    phases = np.exp(2j * np.pi * transform_points(motion.trajectory.at(instants), corners(motion.frame_shape)))
    phase = np.mean([abs(each.mean(axis=0)).mean(axis=0).max() for each in np.array_split(phases, min(in_view, len(phases)))])
    return detail_of(first, last, frames, seen, scale=canvas.scale, noise=ratio, phase=float(phase))


def reduced(canvas: Canvas, most_pixels: float) -> Canvas:
    """Return a canvas with fewer px for one of a frame, if it has more pixels than these."""
    factor = float(np.sqrt(most_pixels / (canvas.height * canvas.width)))
    if factor >= 1:
        return canvas
    height, width = (max(int(factor * each), 1) for each in canvas.shape)
    return replace(canvas, height=height, width=width, transform=rescaling(factor) @ canvas.transform)


def _blocks(
    source: Source,
    motion: FrameMotion,
    spans: Sequence[FrameSpan],
    *,
    canvas: Canvas,
    tolerance_px: float,
    context: Context,
) -> list[_Block]:
    """Merge the frames of each span on the part of the canvas that they cover."""
    with context.progress.stage("halves", len(motion.span) * channels_of(source), "frames") as advance:
        merged = partial(_block, source, motion, canvas, MergeRenderer(context.in_order), tolerance_px, advance)
        return [merged(span) for span in spans]


def _block(  # noqa: PLR0917
    source: Source,
    motion: FrameMotion,
    canvas: Canvas,
    renderer: MergeRenderer,
    tolerance_px: float,
    advance: Callable[[int], None],
    block: FrameSpan,
) -> _Block:
    along = motion.trajectory.at(np.linspace(block.start, block.stop - 1, _SAMPLED).round())
    footprints = footprints_of(canvas, capture_of(source).camera, along, motion.frame_shape)
    rows = _around((each.rows for each in footprints), canvas.height)
    # Where a frame crosses the seam of a full turn, the part is as wide as the canvas.
    columns = _around((each for footprint in footprints for each in footprint.columns), canvas.width)
    part = canvas.part(columns.start, rows.start, rows.stop - rows.start, columns.stop - columns.start)

    def of_colour(each: Source) -> Panorama:
        return renderer.render(each, motion.trajectory, block, part, tolerance_px, advance)

    picture = in_colours(source, of_colour)
    flux, weight = (each.reshape(*part.shape, -1) for each in (picture.flux, picture.weight))
    return _Block((rows, columns), np.where(weight > 0, flux * weight, np.float32(0)), weight)


def _around(ranges: Iterable[range], length: int) -> slice:
    """Return what holds ranges of rows or columns, and a margin for frames between those that were looked at."""
    seen = [each for each in ranges if each] or [range(1)]
    low, high = min(each.start for each in seen), max(each.stop for each in seen)
    return slice(max(low - _MARGIN_PX, 0), min(high + _MARGIN_PX, length))


def _add(sums: FluxImage, block: _Block, sign: int) -> None:
    for total, values in zip(sums, (block.lit, block.weight), strict=True):
        total[block.part] += sign * values


def _beside(pair: tuple[_Block, _Block], totals: FluxImage) -> FluxImage:
    """Return the sums of two blocks, and of all others, where the blocks lie: (4, 2, h, w, C), given (2, 2, H, W, C) of all."""
    top, left = (min(block.part[axis].start for block in pair) for axis in (0, 1))
    bottom, right = (max(block.part[axis].stop for block in pair) for axis in (0, 1))
    others = totals[:, :, top:bottom, left:right]
    own = np.zeros_like(others)
    for of_block, block in zip(own, pair, strict=True):
        rows, columns = block.part
        part = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
        _add(of_block, block._replace(part=part), 1)
    return np.concatenate([own, others - own])


def _compared(sums: FluxImage, response: Response, widest_px: float) -> _Agreement:
    """Compare two sets of frames, that are off by at most `widest_px`: (4, 2, H, W, C) sums of flux and weight, two parts each.

    Where noise hides what fine structure ties, as before a scene that is blurred, coarser structure is compared.
    """
    found = _Agreement(np.nan, np.nan, (widest_px, widest_px), np.nan)
    seen = np.asarray((sums[:, 1] >= _LEAST_LIGHT).all(axis=0))
    if not seen.any():
        return found
    (top, bottom), (left, right) = (np.flatnonzero(seen.any(axis=(axis, 2)))[[0, -1]] for axis in (1, 0))
    if top == bottom or left == right:  # a single row or column has no gradient across it
        return found
    part = slice(top, bottom + 1), slice(left, right + 1)
    lit, weight = sums[:, 0][:, *part], np.maximum(sums[:, 1][:, *part], np.float32(1e-6))
    known, noise = seen[part].astype(np.float32), np.float32(0)
    for first in (0, 2):  # of the mean of the parts of a half
        frames = weight[first] + weight[first + 1]
        noise = noise + frame_variance(np.maximum((lit[first] + lit[first + 1]) / frames, _DARKEST), response) / frames
    pictures, scale = lit / weight * known, known / np.sqrt(noise)
    for number, blur_px in enumerate(_BLURS_PX):
        within = np.maximum(_blurred(known, blur_px), np.float32(1e-6))
        smooth = [_blurred(picture, blur_px) / within for picture in pictures]
        gradients = np.array([[np.gradient(each, axis=axis) * scale for axis in (1, 0)] for each in smooth])
        coarser = _agreement(gradients, widest_px, round(_SQUARE_PX * blur_px))
        strong, weak = (min(pair) for pair in zip(found.std_px, coarser.std_px, strict=True))
        found = (found if number else coarser)._replace(std_px=(strong, weak))
        if weak < widest_px:
            break
    return found


def _blurred(picture: FluxImage, blur_px: float) -> FluxImage:
    blurred = cv2.GaussianBlur(picture, (0, 0), blur_px, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred.reshape(picture.shape))


def _agreement(gradients: FluxImage, widest_px: float, square_px: int) -> _Agreement:
    """Compare the gradients of four pictures, in units of their noise: (4, 2, h, w, C)."""
    # The means of both parts of each half, and then half their differences.
    parts = np.array([[1, 1, 0, 0], [0, 0, 1, 1], [1, -1, 0, 0], [0, 0, 1, -1]]) / 2
    products = np.einsum("ak,klnij,bl->abnij", parts, _of_squares(gradients, square_px), parts, optimize=True)
    between = products[0, 1]
    information = between.sum(axis=0)
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    # Products of one part with the difference of others have noise, and no signal.
    errors = products[0, 3], products[2, 1], products[2, 3]
    squares = [np.square(np.einsum("is,nij,js->ns", vectors, each, vectors)).sum(axis=0) for each in errors]
    std = np.sqrt(np.maximum(squares[0] + squares[1] - squares[2], 0))
    weak, strong = (1 / np.sqrt(np.maximum(values - _ERRORS * std, 0) + 1 / widest_px**2)).tolist()
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])) % 180)
    own = [np.trace(products[i, i] - products[i + 2, i + 2], axis1=1, axis2=2) for i in (0, 1)]
    across, (before, after) = np.trace(between, axis1=1, axis2=2), (each.sum() for each in own)
    if min(before, after) <= 0:
        return _Agreement(np.nan, np.nan, (strong, weak), angle)
    coherence = across.sum() / np.sqrt(before * after)
    # Where the motion is right, each square has the same coherence but for its noise.
    left = across - coherence / 2 * (own[0] * np.sqrt(after / before) + own[1] * np.sqrt(before / after))
    return _Agreement(float(coherence), float(np.sqrt((left**2).sum() / (before * after))), (strong, weak), angle)


def _of_squares(gradients: FluxImage, square_px: int) -> FloatArray:
    """Return the sums over squares of products of gradients, (4, 2, h, w, C), of each two pictures: (4, 4, N, 2, 2)."""
    *_, height, width, colours = gradients.shape
    rows, columns = (-(-length // square_px) for length in (height, width))
    filled = np.zeros((8, rows * square_px, columns * square_px, colours), np.float32)
    filled[:, :height, :width] = gradients.reshape(8, height, width, colours)
    squares = filled.reshape(8, rows, square_px, columns, -1).transpose(1, 3, 0, 2, 4).reshape(rows * columns, 8, -1)
    products = squares @ squares.transpose(0, 2, 1)
    return products.astype(np.float64).reshape(-1, 4, 2, 4, 2).transpose(1, 3, 0, 2, 4)
