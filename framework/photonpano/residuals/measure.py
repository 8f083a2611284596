"""Measure what the panorama does not explain: one pass over the frames, summed over time, sensor and panorama."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture
from photonpano.execution.context import Context
from photonpano.geometry import corners, inverse, steps_px, transform_points
from photonpano.residuals.block_sums import (
    BLOCK_PX,
    GX_R,
    GXX,
    GXY,
    GY_R,
    GYY,
    N_SUMS,
    Totals,
    add_block_sums,
    add_pixel_sums,
    fold,
    n_blocks,
)
from photonpano.residuals.patterns import PartsApart, Shaking, find_shaking, parts_apart
from photonpano.residuals.prediction import Prediction, Predictions
from photonpano.values import Counts, FloatArray, FluxImage, FrameSpan, SpanResiduals

N_STEPS = 4  # steps of the motion: shift along x and y, roll, zoom. The gain of the light is the fifth unknown of a span
# Spans are long enough that photon noise moves their shift by no more than this, if the limits below allow it.
_NOISE_PX = 0.025
_SHORTEST, _LONGEST = 12, 64  # fewest and most frames of a span, if the motion is slow
_MAX_MOTION_PX = 2.0  # a span is short enough that the image moves by no more than this
# Spans are divided where the motion jumps from one frame to the next: by this much, and this many times the usual step.
_JUMP_PX, _JUMP_RATIO = 1.0, 5.0
_FEWEST_SPANS = 64  # a capture is divided into at least this many spans, if it has the frames
_BATCH = 64  # spans that a thread measures at a time
# Most frames that are measured one by one, and most as a share of the capture, to see what moves faster than a span; and the
# fewest in a row.
_SINGLE_FRAMES, _SINGLE_SHARE, _WINDOW_FRAMES = 512, 1 / 8, 32
FEWEST_FRAMES = 3  # frames of the shortest span within which single frames show shaking
# Where photon noise makes spans long: shorter ones, whose neighbours are compared, most pairs of each, and pixels of a square.
_BRIEF_FRAMES, _BRIEF_PAIRS, _SQUARE_PX = (4, 16), 192, 2
_DARK = 1e-6  # least weight of a frame in the mean motion of a span
_PROBES = 8  # instants at which the noise of a shift is predicted
# Information that keeps the equations of a span regular: a shift is below 10 px, a roll or a zoom below 0.1, and the light
# changes by less than a factor of 10.
_PRIOR = np.array([1e-2, 1e-2, 1e2, 1e2, 1e-2])
_SHRUNK = 0.5  # share of what is known of the shift of a single frame that comes from it, from which on the photons say nothing


class Lasting(NamedTuple):
    """What neighbouring spans have in common beyond the prediction: an image that is sharper, or elsewhere, for a while."""

    share: float  # of the power of the predicted contrast
    sigmas: float  # in standard deviations by photon noise
    frames: int  # of each span


@dataclass(frozen=True, eq=False, kw_only=True)
class Residuals:
    """Observed minus predicted photons, summed in four ways."""

    spans: tuple[FrameSpan, ...]  # S spans of frames, in order, that together are the located frames
    instants: FloatArray  # (S,) their centres
    # (S, 5, 5) matrices of the least-squares equations of the spans: shift along x and y in px, roll in radians, zoom and gain
    # as fractions
    normal: FloatArray
    gradient: FloatArray  # (S, 5) right-hand sides of these equations
    reduced_chi2: FloatArray  # (S,) mean over the blocks of a span of squared residual / variance, expected to be 1
    blocks: FloatArray  # (h, w, 12) sums over time, for each block of the sensor: see `block_sums`
    block_chi2: FloatArray  # (h, w) mean over time of squared residual / variance of each block, NaN where nothing was seen
    pixel_gain: FluxImage  # (H, W) observed / predicted photons of each pixel of the sensor, NaN where nothing was predicted
    pixel_mean: FluxImage  # (H, W) predicted photons of each pixel
    pixel_slopes: FluxImage  # (6, H, W) how pixels lie beside the panorama: see `add_pixel_sums`
    # (H', W') mean of squared residual / variance over the panorama, in squares of 16 px; NaN where nothing was seen
    cell_chi2: FloatArray
    cell_count: FloatArray  # (H', W') number of blocks that fell on each square
    # (H', W') mean over these blocks of variance / squared prediction: the squared relative noise of a block
    cell_noise: FloatArray
    frames_seen: float  # frames that saw a place of the panorama, the median over its pixels
    frame_shape: tuple[int, int]  # (height, width) of a frame
    light: FloatArray  # (S,) mean gain of the light of each span, 1 in steady light
    shaking: Shaking  # motion that is faster than a span

    @cached_property
    def apart(self) -> PartsApart | None:
        """The parts of the sensor that lie beside each other most clearly: see `parts_apart`."""
        return parts_apart(self.pixel_slopes)

    def steps(self) -> SpanResiduals:
        """Solve for the motion of each span; the gain of the light is solved for, too, and left out."""
        return SpanResiduals(self.spans, *_solved(self.normal, self.gradient))

    def moved(self, steps: FloatArray) -> Residuals:
        """Return the residuals after steps (S, 4) of the spans, to first order; chi-square stays that before them."""
        return replace(self, gradient=self.gradient - (self.normal[:, :, :N_STEPS] @ steps[..., None])[..., 0])

    def gains(self) -> tuple[FloatArray, FloatArray]:
        """Return the relative brightness of each span minus 1, and its standard deviation by photon noise: (S,) each."""
        information = self.normal + np.diag(_PRIOR)
        covariance = np.linalg.inv(information)
        solved = np.einsum("sij,sj->si", covariance, self.gradient)
        return solved[:, N_STEPS], np.sqrt(covariance[:, N_STEPS, N_STEPS])

    def block_shifts(self) -> tuple[FloatArray, FloatArray]:
        """Return the mean shift of each block of the sensor against the panorama, (h, w, 2) in px, and its information.

        That is (h, w, 2, 2), inverse covariances by photon noise, 0 where a block carries no shift.
        """
        information = np.stack([self.blocks[..., [GXX, GXY]], self.blocks[..., [GXY, GYY]]], axis=-2)
        right = self.blocks[..., [GX_R, GY_R]]
        determined = np.linalg.det(information) > 1e-6 * np.trace(information, axis1=-2, axis2=-1) ** 2
        information = np.where(determined[..., None, None], information, 0)
        field = np.linalg.solve(np.where(determined[..., None, None], information, np.eye(2)), right[..., None])[..., 0]
        return np.where(determined[..., None], field, 0), information


def measure(span: FrameSpan, predictions: Predictions, context: Context) -> Residuals:
    """Compare the located frames with what the panorama predicts along the motion, each pixel in its colour.

    Spans are shorter where single frames of some windows show that the image shakes faster.
    """
    size, spans = spans_of(span, predictions)
    shaking = _shaking(spans, size, predictions, context)
    if shaking.size_px:
        _, spans = spans_of(span, predictions, shaking.span_frames)
    # The mean over the frames, which is not the motion at the centre where frames are repeated, or tremble.
    starts = [each.start - span.start for each in spans]
    trajectory, changing = predictions.first.trajectory, predictions.first.light
    of_frames = trajectory.at(np.arange(span.start, span.stop))
    if changing is None:
        light = np.ones(len(spans))
        homographies = np.add.reduceat(of_frames, starts) / np.array([len(each) for each in spans])[:, None, None]
    else:
        gain = np.maximum(changing.gain[span.start : span.stop], _DARK)
        light = np.array([changing.mean(each) for each in spans])
        homographies = np.add.reduceat(gain[:, None, None] * of_frames, starts) / np.add.reduceat(gain, starts)[:, None, None]
    batches = [slice(first, first + _BATCH) for first in range(0, len(spans), _BATCH)]
    work = partial(_measured, predictions, spans, homographies)
    total: Totals | None = None
    results: list[tuple[FloatArray, ...]] = []
    with context.progress.stage("residuals", len(span), "frames") as advance:
        for batch, (of_spans, part) in zip(batches, context.in_order(work, batches), strict=True):
            results.append(of_spans)
            total = part if total is None else total.plus(part)
            advance(sum(map(len, spans[batch])))
    assert total is not None
    normal, gradient, reduced_chi2 = (np.concatenate(arrays) for arrays in zip(*results, strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel_gain = np.where(total.pixel_mean > 0, 1 + total.pixel_residual / total.pixel_mean, np.float32(np.nan))
        return Residuals(
            spans=spans,
            instants=np.array([each.centre for each in spans]),
            normal=normal,
            gradient=gradient,
            reduced_chi2=reduced_chi2,
            blocks=total.blocks,
            block_chi2=total.block_chi2 / total.block_count,
            pixel_gain=np.asarray(pixel_gain, np.float32),
            pixel_mean=total.pixel_mean,
            pixel_slopes=total.pixel_slopes,
            cell_chi2=total.cell_chi2 / total.cell_count,
            cell_count=total.cell_count,
            cell_noise=total.cell_noise / total.cell_count,
            frames_seen=predictions.frames_seen,
            frame_shape=predictions.first.frame_shape,
            light=light,
            shaking=shaking,
        )


def noise_hides_shifts(residuals: Residuals) -> bool:
    """Return whether photon noise makes spans so long that a motion within them does not show."""
    return float(np.median([len(span) for span in residuals.spans])) >= 2 * max(_BRIEF_FRAMES)


def lasting_of(residuals: Residuals, predictions: Predictions, context: Context) -> Lasting:
    """Compare neighbouring brief spans all over the capture: photon noise has nothing in common in them."""
    spans, found = residuals.spans, list[Lasting]()
    for n_frames in _BRIEF_FRAMES:
        long = [span for span in spans if len(span) >= 2 * n_frames]
        taken = np.unique(np.linspace(0, len(long) - 1, min(len(long), _BRIEF_PAIRS)).astype(int)).tolist()
        pairs = [FrameSpan(long[index].start, long[index].start + 2 * n_frames) for index in taken]
        common, variance, contrast = np.sum(list(context.in_order(partial(_in_common, predictions), pairs)), axis=0)
        found.append(Lasting(common / max(contrast, 1e-9), common / max(np.sqrt(variance), 1e-9), n_frames))
    return max(found, key=lambda each: each.sigmas)


def _in_common(predictions: Predictions, span: FrameSpan) -> FloatArray:
    """Return the product of what both halves of a span have beyond the prediction, its variance, and that of the contrast."""
    sums, shape = np.zeros(3), predictions.first.frame_shape
    size, images = (shape[1] // _SQUARE_PX, shape[0] // _SQUARE_PX), np.empty((2, *shape), np.float32)
    for part in predictions.parts:
        colour, halves = _Colour.of(*part), []
        for half in (FrameSpan(span.start, int(span.centre + 0.5)), FrameSpan(int(span.centre + 0.5), span.stop)):
            colour.prediction.view(colour.prediction.trajectory.at([half.centre])[0], images, half)
            counts = colour.counted(colour.capture.chunk(half), half)
            known = (images[1] > 0) & np.isfinite(counts)
            counts, mean = np.where(known, counts, np.float32(0)), np.where(known, images[0], np.float32(0))
            mean *= counts.sum(dtype=np.float64) / max(mean.sum(dtype=np.float64), 1e-9)
            halves.append([cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (counts - mean, mean)])
        (one, expected), (other, expected_there) = halves
        lit = expected[expected > 0]
        noise = (expected * expected_there).sum() / _SQUARE_PX**4
        sums += [(one * other).sum(), noise, ((lit - lit.mean()) ** 2).sum() if len(lit) else 0]
    return sums


def _solved(normal: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the steps of the equations of spans, (S, 4), and their information, (S, 4, 4), whatever the gain is."""
    kept, gain = normal[:, :N_STEPS, :N_STEPS], normal[:, N_STEPS, N_STEPS]
    mixed = normal[:, :N_STEPS, N_STEPS]
    weight = 1 / (gain + _PRIOR[N_STEPS])
    information = kept - mixed[:, :, None] * mixed[:, None, :] * weight[:, None, None]
    right = gradient[:, :N_STEPS] - mixed * (weight * gradient[:, N_STEPS])[:, None]
    steps = np.linalg.solve(information + np.diag(_PRIOR[:N_STEPS]), right[..., None])[..., 0]
    return steps, information


def _shaking(spans: Sequence[FrameSpan], size: int, predictions: Predictions, context: Context) -> Shaking:
    """Measure single frames of windows all over the capture, which are as long as a span of `size` frames or longer."""
    length = -(-max(size, _WINDOW_FRAMES) // size) * size
    runs, first = list[FrameSpan](), 0
    for index, each in enumerate(spans):  # frames between two jumps
        if index + 1 == len(spans) or len(each) != size:
            runs.append(FrameSpan(spans[first].start, each.stop))
            first = index + 1
    starts = [start for run in runs for start in range(run.start, run.stop - length + 1, length)]
    if size < FEWEST_FRAMES or not starts:
        return Shaking(0.0, float("nan"), size)
    frames_taken = min(_SINGLE_FRAMES, _SINGLE_SHARE * (spans[-1].stop - spans[0].start))
    taken = np.unique(np.linspace(0, len(starts) - 1, max(1, int(frames_taken) // length)).astype(int))
    windows = [np.arange(starts[index], starts[index] + length) for index in taken]
    results = context.in_order(partial(_of_single_frames, predictions), windows)
    shifts, variances = (np.array(each) for each in zip(*results, strict=True))
    return find_shaking(shifts, variances, size)


def _of_single_frames(predictions: Predictions, frames: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Return the shifts of F frames, (F, 2), and their variances, infinite without texture.

    Roll and zoom are held: the photons of a single frame hardly carry them, and they would add their noise to the shifts.
    """
    spans = [FrameSpan(frame, frame + 1) for frame in frames.tolist()]
    (normal, gradient, _), _ = _measured(predictions, spans, predictions.first.trajectory.at(frames), slice(None))
    kept = [0, 1, N_STEPS]
    information, right = normal[:, kept][:, :, kept], gradient[:, kept]
    covariance = np.linalg.inv(information + np.diag(_PRIOR[kept]))
    # What the prior alone holds is not known.
    variances = np.diagonal(covariance @ information @ covariance, axis1=1, axis2=2)[:, :2]
    shrunk = np.diagonal(covariance, axis1=1, axis2=2)[:, :2] * _PRIOR[:2] > _SHRUNK
    return (covariance @ right[..., None])[:, :2, 0], np.where(shrunk, np.inf, variances)


def spans_of(span: FrameSpan, predictions: Predictions, longest: int = _LONGEST) -> tuple[int, tuple[FrameSpan, ...]]:
    """Divide frames into spans: long enough for the photons to carry a shift, short enough for the motion.

    Returns the number of frames of a span, `longest` at most, and the spans.
    """
    frames = np.arange(span.start, span.stop)
    frame_shape = predictions.first.frame_shape
    homographies = predictions.first.trajectory.at(frames)
    speed, jumps = 0.0, np.empty(0, int)
    if len(frames) > 1:
        moved = steps_px(homographies, frame_shape).mean(axis=-1)
        speed = float(np.quantile(moved, 0.95))
        jumps = span.start + 1 + np.flatnonzero(moved > max(_JUMP_PX, _JUMP_RATIO * speed))
    probes = np.linspace(0, len(frames) - 1, _PROBES).astype(int)
    noise_px = _shift_noise_px(predictions, homographies[probes])
    wanted = np.clip(np.ceil((noise_px / _NOISE_PX) ** 2), _SHORTEST, _LONGEST)
    size = int(min(wanted, _MAX_MOTION_PX / max(speed, 1e-9), len(frames) / _FEWEST_SPANS))
    size = max(1, min(size, longest))
    spans = []
    for piece in pairwise([span.start, *jumps.tolist(), span.stop]):
        bounds = [*range(piece[0], max(piece[1] - size, piece[0]) + 1, size), piece[1]]
        spans += [FrameSpan(start, stop) for start, stop in pairwise(bounds)]
    return size, tuple(spans)


def _shift_noise_px(predictions: Predictions, homographies: FloatArray) -> float:
    """Return the standard deviation of the shift of a single frame by photon noise, the median over some frames."""
    shape = predictions.first.frame_shape
    images = np.empty((2, *shape), np.float32)
    nothing = np.zeros(shape, np.float32)
    # A grey source counts all of its pixels here, the masked ones too.
    in_colour = len(predictions.parts) > 1
    counts = [np.where(each.valid, nothing, np.float32(np.nan)) if in_colour else nothing for each, _ in predictions.parts]
    noises = []
    for homography in homographies:
        sums = np.zeros((*n_blocks(shape), N_SUMS), np.float32)
        for (_, prediction), zero in zip(predictions.parts, counts, strict=True):
            prediction.view(homography, images)
            add_block_sums(zero, nothing, 1.0, images[0], images[1], sums)
        xx, xy, yy = sums[..., :3].sum(axis=(0, 1), dtype=np.float64)
        information = np.array([[xx, xy], [xy, yy]]) + 1e-12 * np.eye(2)
        noises.append(float(np.sqrt(np.trace(np.linalg.inv(information)) / 2)))
    return float(np.median(noises))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Colour:
    """Counts and prediction in one colour of the capture."""

    capture: Capture  # its pixels
    prediction: Prediction  # the panorama in this colour
    masked: FluxImage | None  # (H, W) 0, NaN for pixels of other colours and masked ones; None if there is none
    # takes everything but the flux out of a sum of frames; None if there is nothing else
    corrected: Callable[[Counts, int], FluxImage] | None
    dark: FluxImage  # (H, W) what it subtracts for each frame
    extra: FluxImage  # (H, W) the variance that this adds to the count of a frame
    slope: FluxImage | None  # (H, W) factor of the counts; None for frames of grey levels, and if there is nothing to correct

    @classmethod
    def of(cls, capture: Capture, prediction: Prediction) -> _Colour:
        shape = prediction.frame_shape
        corrected = capture.corrected if capture.corrects_sums else None
        zeros = np.zeros(shape, np.uint32)
        # Corrected counts are `slope * counts - n * dark`: counts of the dark, and of less sensitive pixels, add noise.
        dark = np.zeros(shape, np.float32) if corrected is None else -corrected(zeros, 1)
        slope = corrected(zeros + 1, 1) + dark if corrected is not None and capture.info.kind == "binary" else None
        masked = None if capture.valid.all() else np.where(capture.valid, np.float32(0), np.float32(np.nan))
        return cls(
            capture=capture,
            prediction=prediction,
            masked=masked,
            corrected=corrected,
            dark=dark,
            extra=np.maximum(dark, 0),
            slope=slope,
        )

    def counted(self, raw: Counts, span: FrameSpan) -> NDArray[np.float32] | NDArray[np.uint8]:
        """Return the counts of a span, corrected, NaN where masked or where something hides the background: (H, W)."""
        counts: Any = raw if self.corrected is None else self.corrected(raw, len(span))
        if (shown := self.capture.shown_pixels(span)) is not None:
            counts = np.where(shown, counts, np.float32(np.nan))
        if counts.dtype != np.uint8:
            counts = np.ascontiguousarray(counts, np.float32)
        found: NDArray[np.float32] | NDArray[np.uint8] = counts if self.masked is None else counts + self.masked
        return found

    def noise_beside(self, mean: FluxImage, variance: FluxImage, span: FrameSpan) -> FluxImage:
        """Return the variance of the count of a frame beside that of its photons, which copies of frames raise: (H, W)."""
        extra = self.extra
        if self.slope is not None:
            lit = np.clip((mean + self.dark) / self.slope, 0, 1)
            extra = np.asarray(np.maximum(self.slope**2 * lit * (1 - lit) - mean * (1 - mean), 0), np.float32)
        times = np.float32(self.capture.times_counted(span))
        return extra if times == 1 else times * extra + (times - 1) * variance


def _measured(
    predictions: Predictions, spans: Sequence[FrameSpan], homographies: FloatArray, batch: slice
) -> tuple[tuple[FloatArray, FloatArray, FloatArray], Totals]:
    """Return the equations and the reduced chi-square of a batch of spans, and the sums over them."""
    first = predictions.first
    shape = first.frame_shape
    grid = n_blocks(shape)
    spans, homographies = spans[batch], homographies[batch]
    height, width = shape
    row, column = np.mgrid[: grid[0], : grid[1]]
    middle = np.stack([_middles(column, width), _middles(row, height)], axis=-1)
    lever = middle - corners(shape).mean(axis=0)
    ideal = first.ideal(middle)
    colours = [_Colour.of(*part) for part in predictions.parts]
    normal, gradient, reduced_chi2 = np.zeros((len(spans), 5, 5)), np.zeros((len(spans), 5)), np.zeros(len(spans))
    total = Totals.zeros(shape, first.canvas.shape)
    # A pixel adds to the image of its colour, which fewer frames may have seen.
    frames_seen = max(float(np.mean([each.frames_seen for _, each in predictions.parts])), 1.0)
    images, sums = np.empty((2, *shape), np.float32), np.empty((*grid, N_SUMS), np.float32)
    velocities = _velocities(first, spans)
    for index, (span, homography) in enumerate(zip(spans, homographies, strict=True)):
        sums[:] = 0
        for place, colour in enumerate(colours):
            if place == 0 or predictions.in_channels:
                raw = colour.capture.chunk(span)
            counts = colour.counted(raw, span)
            colour.prediction.view(homography, images, span)
            noise = colour.noise_beside(images[0], images[1], span)
            add_block_sums(counts, noise, float(len(span)), images[0], images[1], sums)
            of_pixels = total.pixel_residual, total.pixel_mean, total.pixel_slopes
            add_pixel_sums(counts, float(len(span)), images[0], images[1], *of_pixels, velocities[index])
        # The photons of the span are part of the panorama, so that the residual is less than their noise.
        own = min(0.5, len(span) / frames_seen)
        cells = first.cells(homography, middle, ideal)
        reduced_chi2[index] = fold(sums, lever, *cells, 1 - own, normal[index], gradient[index], total)
    return (normal, gradient, reduced_chi2), total


def _velocities(prediction: Prediction, spans: Sequence[FrameSpan]) -> NDArray[np.float32]:
    """Return how fast the image moves in spans, in px of a frame per frame period: (S, 2)."""
    middle, ends = corners(prediction.frame_shape).mean(axis=0), np.array([(each.start, each.stop - 1) for each in spans])
    first, last = (prediction.trajectory.at(each) for each in ends.T)
    moved = transform_points(inverse(last) @ first, middle[None])[:, 0] - middle
    return np.asarray(moved / np.maximum(np.ptp(ends, axis=1), 1)[:, None], np.float32)


def _middles(index: np.ndarray, length: int) -> FloatArray:
    """Return the coordinates of the centres of blocks; the last one may be cut off by the border of the frame."""
    return np.asarray((index * BLOCK_PX + np.minimum((index + 1) * BLOCK_PX, length) - 1) / 2, np.float64)
