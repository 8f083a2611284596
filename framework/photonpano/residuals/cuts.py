"""Find where the image jumps from one frame to the next, as it does where frames are missing or sent twice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.geometry import steps_px
from photonpano.merging import binned_mean, binning_of
from photonpano.motion.timeline import Cut
from photonpano.motion.tracking.spans import DARK, SumTrack, span_image, track_sums
from photonpano.residuals.refinement import MotionFit, standing_out
from photonpano.values import FloatArray, FluxImage, FrameSpan, true_spans

# Sums searched on both sides of spans that stand out.
_MARGIN = 20
# Wanted noise of a shift between two sums, and its ratio to the noise of a shift against the panorama.
_TRACK_NOISE_PX, _TRACK_RATIO = 0.25, 10.0
# Fewest and most frames of a sum, and most motion within it.
_SHORTEST, _LONGEST, _MOTION_PX = 4, 64, 4.0
# Least size of an outlier, absolute and as a multiple of the median around it.
_SMALLEST_PX, _OUTLIER = 1.0, 4.5
# Sums on either side that this median takes.
_LOCAL = 24
# Fewest sums for this median.
_FEWEST = 6
# Sums before and after a jump that make the template of the frames between.
_SIDE = 4
# Standard deviation of the Gaussian that smooths the template, in binned px.
_BLUR_PX = 0.7
# Parts into which a jump is divided, to compare it with fast motions.
_STEPS = 8
# Lengths of these fast motions, in frames.
_SHORT_RAMP, _RAMPS = 4, (8, 16, 32, 64, 128)
# Standard deviations by which a jump must be likelier than a motion of 8 frames or more. A motion of 4 must not be likelier.
_SURE = 4.0
# Least variance of a binned pixel.
_NOISE_FLOOR = 1e-4


@dataclass(frozen=True, slots=True)
class _Outlier:
    """A shift between two sums that the motion before and after does not explain."""

    before: int  # number of the sum before
    after: int  # number of the sum after
    shift_px: FloatArray  # (2,) what is not explained, in binned px
    sigmas: float  # its size in standard deviations


def find_cuts(source: Source, fit: MotionFit, context: Context) -> tuple[Cut, ...]:
    """Find the places where the image jumps.

    Places come into question where spans stand out from the motion. There, sums of a few frames are tracked by phase
    correlation, from frames alone. Where a shift is an outlier, each frame is compared with templates from before and after,
    and a jump at each frame with fast motions: see `_located`.
    """
    size = _size_of_sums(fit)
    suspect = _suspect(fit, _MARGIN * size)
    if not suspect:
        return ()
    found: list[Cut] = []
    with context.progress.stage("cuts", sum(map(len, suspect)), "frames") as advance:
        runs = [[each for each in span.blocks(size) if len(each) == size] for span in suspect]
        for span, track in zip(suspect, track_sums(source, runs, context), strict=True):
            if track is not None:
                found += _cuts_along(source, track, size)
            advance(len(span))
    return tuple(found)


def _suspect(fit: MotionFit, margin: int) -> list[FrameSpan]:
    """Return the frames up to `margin` frames from spans that stand out."""
    spans, flags = fit.residuals.spans, np.zeros(len(fit.motion.located), dtype=bool)
    for index in np.flatnonzero(standing_out(fit.residuals)):
        flags[max(0, spans[index].start - margin) : spans[index].stop + margin] = True
    return true_spans(flags & fit.motion.located)


def _size_of_sums(fit: MotionFit) -> int:
    residuals, homographies = fit.residuals, fit.motion.homographies[fit.motion.located]
    moved = steps_px(homographies, residuals.frame_shape)
    per_frame = residuals.normal[:, [0, 1], [0, 1]].mean(axis=1) / [len(span) for span in residuals.spans]
    noise_px = _TRACK_RATIO / np.sqrt(max(float(np.median(per_frame)), 1e-9))
    wanted = min((noise_px / _TRACK_NOISE_PX) ** 2, _MOTION_PX / max(float(np.median(moved)), 1e-9))
    return int(np.clip(np.ceil(wanted), _SHORTEST, _LONGEST))


def _cuts_along(source: Source, track: SumTrack, size: int) -> Iterator[Cut]:
    """Yield the cuts along a track of sums of `size` frames."""
    for outlier in _outliers(track, size, _SMALLEST_PX / binning_of(source)):
        between = FrameSpan(track.spans[outlier.before].start, track.spans[outlier.after].stop)
        dark = _dark_frames(source, between) if len(between) > 3.5 * size else None
        if dark is not None:
            shift_px = outlier.shift_px * binning_of(source)
            yield Cut((dark.start + dark.stop) // 2, shift_px, outlier.sigmas, dark)
        elif (cut := _located(source, track, outlier)) is not None:
            yield cut


def _outliers(track: SumTrack, size: int, smallest: float) -> list[_Outlier]:
    """Return the shifts that are outliers, each the largest around it.

    The frame of a jump lies in some sum, so that the shift from the sum before to that after is compared with the motion before
    and after. A shift between the two is that of a turn. Where sums without light lie between, the next sum is the one after.
    """
    centres, velocities = track.centres, track.velocities
    before = np.arange(1, len(centres) - 3)
    gap = centres[before + 1] - centres[before] > 1.5 * size
    after = before + np.where(gap, 1, 2)
    tracked = gap | (centres[after] - centres[before] <= 2.5 * size)
    before, after, gap = before[tracked], after[tracked], gap[tracked]
    frames = (centres[after] - centres[before])[:, None]
    found = np.where(gap[:, None], track.next_px[before], track.second_px[before])
    unexplained = _beyond(found, velocities[before - 1] * frames, velocities[after] * frames)
    # Over a longer time, the motion may change by more.
    sizes = np.linalg.norm(unexplained, axis=1) * np.minimum(1, 2 * size / frames[:, 0])
    outliers = []
    for index in np.flatnonzero(sizes > smallest).tolist():
        if sizes[index] < sizes[max(0, index - 3) : index + 4].max():
            continue
        around = np.r_[sizes[max(0, index - _LOCAL) : max(0, index - 3)], sizes[index + 4 : index + _LOCAL + 1]]
        usual = max(float(np.median(around)), smallest / _OUTLIER) if len(around) >= _FEWEST else np.inf
        if sizes[index] > _OUTLIER * usual:
            sigmas = float(sizes[index] / usual)
            outliers.append(_Outlier(int(before[index]), int(after[index]), unexplained[index], sigmas))
    return outliers


def _beyond(found: FloatArray, first: FloatArray, last: FloatArray) -> FloatArray:
    """Return the vectors to N points from the nearest ones between two others: (N, 2)."""
    way = last - first
    share = ((found - first) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1e-12)
    return np.asarray(found - (first + np.clip(share, 0, 1)[:, None] * way))


def _dark_frames(source: Source, span: FrameSpan) -> FrameSpan | None:
    """Return the frames without light in a span; None if there are none."""
    light = np.array(
        [float(np.nanmean(binned_mean(source, FrameSpan(frame, frame + 1)))) for frame in range(span.start, span.stop)]
    )
    runs = true_spans(light <= DARK * np.quantile(light, 0.9))
    if not runs:
        return None
    longest = max(runs, key=len)
    return FrameSpan(span.start + longest.start, span.start + longest.stop)


def _located(source: Source, track: SumTrack, outlier: _Outlier) -> Cut | None:
    """Find the first frame after a jump; None if a fast motion explains the frames as well.

    The log likelihood of each frame is that of its residual from a template, seen from the path before the jump, from that
    after, and from positions between. A jump takes the image from the one to the other at once, a fast motion in some frames.
    """
    path = _Path.of(track, outlier)
    template = _template(source, track, outlier, path)
    frames = range(track.spans[outlier.before].start, track.spans[outlier.after].stop)
    likelihood = np.empty((len(frames), _STEPS + 1))
    for row, frame in enumerate(frames):
        image = binned_mean(source, FrameSpan(frame, frame + 1))
        expected = [_moved(template, path.at(frame, share)) for share in np.linspace(0, 1, _STEPS + 1)]
        likelihood[row] = _log_likelihoods(image, np.array(expected), binning_of(source) ** 2)
    jumps = _likelihoods_of(likelihood, 0)
    at = min(int(np.argmax(jumps)), len(frames) - 1)
    short, *motions = (float(_likelihoods_of(likelihood, ramp).max()) for ramp in (_SHORT_RAMP, *_RAMPS))
    sigmas = np.sqrt(2 * max(float(jumps[at]) - max(motions), 0.0))
    cut = Cut(frames[at], path.jump * binning_of(source), float(sigmas))
    return None if sigmas < _SURE or short > jumps[at] or cut.size_px < _SMALLEST_PX else cut


@dataclass(frozen=True, slots=True)
class _Path:
    """A smooth path of the image with a jump: a cubic polynomial of time, and a step."""

    middle: float  # the instant around which time is counted
    scale: float  # frames of a unit of time
    coefficients: FloatArray  # (4, 2) of the polynomial, in binned px
    jump: FloatArray  # (2,) the step

    @classmethod
    def of(cls, track: SumTrack, outlier: _Outlier) -> _Path:
        """Fit the path to the sums on both sides of an outlier."""
        before, after = outlier.before, outlier.after
        across = track.next_px[before] if after == before + 1 else track.second_px[before]
        numbers = _beside(track, outlier)
        places = [
            -track.next_px[number:before].sum(axis=0) if number <= before else across + track.next_px[after:number].sum(axis=0)
            for number in numbers
        ]
        centres = track.centres[numbers]
        middle = float(centres[[numbers.index(before), numbers.index(after)]].mean())
        scale = float(np.abs(centres - middle).max())
        equations = np.column_stack([_powers((centres - middle) / scale), np.asarray(numbers) >= after])
        solution = np.linalg.lstsq(equations, np.array(places))[0]
        return cls(middle, scale, solution[:-1], solution[-1])

    def at(self, instant: float, share: float) -> FloatArray:
        """Return where the image is after a share of the jump: (2,) in binned px."""
        return np.asarray(_powers(np.array([(instant - self.middle) / self.scale]))[0] @ self.coefficients + share * self.jump)


def _powers(times: FloatArray) -> FloatArray:
    return np.asarray(times[:, None] ** np.arange(4))


def _beside(track: SumTrack, outlier: _Outlier) -> list[int]:
    """Return the numbers of the sums before and after an outlier."""
    first, last = max(0, outlier.before - _SIDE), min(len(track.spans), outlier.after + _SIDE + 1)
    return [*range(first, outlier.before + 1), *range(outlier.after, last)]


def _template(source: Source, track: SumTrack, outlier: _Outlier, path: _Path) -> FluxImage:
    """Average the sums on both sides of an outlier, taken back along the path: (h, w); NaN beyond their borders."""
    moved = [
        _moved(span_image(source, track.spans[number]), -path.at(track.spans[number].centre, float(number >= outlier.after)))
        for number in _beside(track, outlier)
        if number not in (outlier.before, outlier.after)
    ]
    seen = np.isfinite(moved)
    mean = np.where(seen, moved, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    smooth = cv2.GaussianBlur(mean.astype(np.float32), (0, 0), _BLUR_PX)
    return np.where(seen.any(axis=0), smooth, np.float32(np.nan))


def _moved(image: FluxImage, shift: FloatArray) -> FluxImage:
    """Return an image moved by (x, y) binned px; NaN where nothing is known."""
    matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    border = cv2.BORDER_CONSTANT
    size, nothing = image.shape[::-1], float("nan")
    return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=border, borderValue=nothing))


def _log_likelihoods(image: FluxImage, expected: FloatArray, n_pixels: int) -> FloatArray:
    """Return the log likelihoods (P,) of a frame, up to a constant, for P expectations (P, h, w), NaN where unknown.

    A binned pixel (h, w) is the mean of `n_pixels`.
    """
    seen = np.isfinite(expected).all(axis=0) & np.isfinite(image)
    variance = np.maximum(expected[:, seen].mean(axis=0), _NOISE_FLOOR) / n_pixels
    return np.asarray(-0.5 * ((image[seen] - expected[:, seen]) ** 2 / variance).sum(axis=1))


def _likelihoods_of(likelihood: FloatArray, ramp: int) -> FloatArray:
    """Return the log likelihood of motions that take `ramp` frames from the old path to the new one, for each middle: (M,).

    `likelihood` is (T, steps + 1), that of each frame from the old path to the new one. Of a jump, whose ramp is 0, the middle
    is its first frame.
    """
    n_frames, steps = likelihood.shape[0], likelihood.shape[1] - 1
    frames, middles = np.arange(n_frames), np.arange(n_frames + 1)
    passed = frames + 0.5 - middles[:, None]
    share = (passed > 0).astype(float) if ramp == 0 else np.clip(passed / ramp + 0.5, 0, 1)
    return np.asarray(likelihood[frames, np.rint(share * steps).astype(int)].sum(axis=1))
