"""Find where the image jumps from one frame to the next, as it does where frames are missing or sent twice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.filtering import gradient_of
from photonpano.geometry import corners, inverse, steps_px, transform_points
from photonpano.locating import shift_of_spectra
from photonpano.merging import binned_mean, binning_of
from photonpano.motion.level import Cut
from photonpano.motion.tracking import DARK, PEAK_PX, Spectrum, span_image, spectra_of
from photonpano.residuals.prediction import Predictions
from photonpano.residuals.refinement import MotionFit
from photonpano.values import BoolArray, FloatArray, FluxImage, FrameSpan, true_spans

# Change of the residual shift, and of the reduced chi-square, from one span to the second next where a jump is looked for.
_SUDDEN_PX, _SUDDEN_CHI2 = 0.7, 2.0
# Sums searched on both sides of such a place.
_MARGIN = 20
# Wanted noise of a shift between two sums, and its ratio to the noise of a shift against the panorama.
_TRACK_NOISE_PX, _TRACK_RATIO = 0.35, 10.0
# Fewest and most frames of a sum, and most motion within it.
_SHORTEST, _LONGEST, _MOTION_PX = 4, 64, 2.0
SMALLEST_PX = 1.0  # least size of a jump
# Least size of an outlier, as a multiple of the median around it.
_OUTLIER = 4.5
# Sums, or spans, on either side that this median takes.
_LOCAL = 24
# Fewest of them for this median.
_FEWEST = 6
# Sums before and after a jump whose frames are compared with each other.
_SIDE = 4
# Standard deviation of the Gaussian that smooths the template, in binned px.
_BLUR_PX = 0.7
# Along a direction whose information is below this share of the best one, nothing is known of a jump.
_INFORMED = 0.02
# Parts into which a jump is divided, to compare it with fast motions.
_STEPS = 8
# Lengths of these fast motions, in frames.
_SHORT_RAMP, _RAMPS = 4, (8, 16, 32, 64, 128)
# Standard deviations by which a jump must be likelier than a smooth motion, in frames that are held out, and than a motion of
# 8 frames or more. A motion of 4 must not be likelier.
_SURE = 4.0
# Least variance of a binned pixel.
_NOISE_FLOOR = 1e-4


@dataclass(frozen=True, slots=True)
class _Outlier:
    """A shift between two sums that the motion before and after does not explain."""

    before: int  # number of the sum before
    after: int  # number of the sum after
    sigmas: float  # its size in standard deviations


def find_cuts(source: Source, fit: MotionFit, context: Context) -> tuple[Cut, ...]:
    """Find the places where the image jumps.

    Places come into question where the residuals change suddenly. There, sums of a few frames are tracked by phase correlation.
    Where a shift is an outlier, frames on both sides that have not suggested it must be likelier with a jump than with a smooth
    motion. Then a jump at each frame between is compared with fast motions: see `_located`.
    """
    size = _size_of_sums(fit)
    suspect = _suspect(fit, _MARGIN * size)
    if not suspect:
        return ()
    found: list[Cut] = []
    with context.progress.stage("cuts", sum(map(len, suspect)), "frames") as advance:
        for span in suspect:
            for track in _tracks(source, fit, span, size, context):
                found += _cuts_along(source, track, size, found)
            advance(len(span))
    return tuple(sorted(found, key=lambda cut: cut.frame))


def _suspect(fit: MotionFit, margin: int) -> list[FrameSpan]:
    """Return the frames up to `margin` frames from places where the residuals change suddenly, measured by those around."""
    residuals, flags = fit.residuals, np.zeros(len(fit.motion.located), dtype=bool)
    shifts, chi2 = residuals.steps().steps[:, :2], residuals.reduced_chi2
    # The frame of a jump lies in some span: those before and after it are compared.
    changes = np.linalg.norm(shifts[2:] - shifts[:-2], axis=1)
    for index, _ in [*_outstanding(changes, _SUDDEN_PX), *_outstanding(np.abs(chi2[2:] - chi2[:-2]), _SUDDEN_CHI2)]:
        span = residuals.spans[index + 1]
        flags[max(0, span.start - margin) : span.stop + margin] = True
    return true_spans(flags & fit.motion.located)


def _outstanding(sizes: FloatArray, smallest: float) -> Iterator[tuple[int, float]]:
    """Yield the numbers of sizes that are the largest around, and their ratio to the usual one, where they stand out."""
    for index in np.flatnonzero(sizes > smallest).tolist():
        if sizes[index] < sizes[max(0, index - 3) : index + 4].max():
            continue
        around = np.r_[sizes[max(0, index - _LOCAL) : max(0, index - 3)], sizes[index + 4 : index + _LOCAL + 1]]
        usual = max(float(np.median(around)), smallest / _OUTLIER) if len(around) >= _FEWEST else np.inf
        if sizes[index] > _OUTLIER * usual:
            yield index, float(sizes[index] / usual)


def _size_of_sums(fit: MotionFit) -> int:
    residuals, homographies = fit.residuals, fit.motion.homographies[fit.motion.located]
    moved = steps_px(homographies, residuals.frame_shape)
    per_frame = residuals.normal[:, [0, 1], [0, 1]].mean(axis=1) / [len(span) for span in residuals.spans]
    noise_px = _TRACK_RATIO / np.sqrt(max(float(np.median(per_frame)), 1e-9))
    wanted = min((noise_px / _TRACK_NOISE_PX) ** 2, _MOTION_PX / max(float(np.median(moved)), 1e-9))
    return int(np.clip(np.ceil(wanted), _SHORTEST, _LONGEST))


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """Sums of successive frames with light, and where they show the image, in binned px."""

    first: int  # the first of T frames
    followed: FloatArray  # (T, 2) where the image is by the motion that was found
    spans: Sequence[FrameSpan]  # (N,) of the sums, in order
    beyond: FloatArray  # (N, 2) by how much it is elsewhere

    @property
    def centres(self) -> FloatArray:
        """(N,) instants, in frames."""
        return np.array([span.centre for span in self.spans])


def _tracks(source: Source, fit: MotionFit, span: FrameSpan, size: int, context: Context) -> tuple[_Track, _Track]:
    """Return where sums of `size` frames show the image: against the panorama, and from each to the next.

    The panorama has little noise, but was made along a motion that takes a large jump for a fast motion.
    """
    binning, middle = binning_of(source), corners(fit.motion.frame_shape).mean(axis=0)[None]
    homographies = fit.motion.homographies[span.start : span.stop]
    steps = transform_points(inverse(homographies[1:]) @ homographies[:-1], middle)[:, 0] - middle
    followed = np.concatenate([np.zeros((1, 2)), steps.cumsum(axis=0)]) / binning
    sums = [each for each in span.blocks(size) if len(each) == size]
    light: list[float] = []
    beyond: list[FloatArray] = []
    chain: list[FloatArray] = [np.zeros(2)]
    last: Spectrum | None = None
    for image, spectrum, shift in context.in_order(partial(_compared, source, fit.predictions), sums):
        light.append(float(image.mean()))
        beyond.append(shift)
        moved = None if last is None else shift_of_spectra(last, spectrum, image.shape, PEAK_PX, gaussian_peak=False)
        chain.append(chain[-1] if moved is None else chain[-1] + moved)
        if light[-1] > DARK * np.median(light[-_LOCAL:]):
            last = spectrum
    lit = np.flatnonzero(np.array(light) > DARK * np.median(light)).tolist() if light else []
    spans = [sums[index] for index in lit]
    against, along = (np.array([each[index] for index in lit]).reshape(-1, 2) for each in (beyond, chain[1:]))
    return _Track(span.start, followed, spans, against), _Track(span.start, np.zeros_like(followed), spans, along)


def _compared(source: Source, predictions: Predictions, span: FrameSpan) -> tuple[FluxImage, Spectrum, FloatArray]:
    """Return a sum, its spectrum, and its shift from the panorama along the motion that was found, in binned px."""
    image = span_image(source, span)
    height, width = (side * binning_of(source) for side in image.shape)
    full = predictions.predicted(span.centre)[0][:height, :width]
    expected = np.asarray(cv2.resize(full, image.shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
    unseen = ~np.isfinite(expected)
    expected[unseen] = image[unseen]
    seen, panorama = spectra_of([image, expected])
    shift = shift_of_spectra(panorama, seen, image.shape, PEAK_PX, gaussian_peak=False)
    return image, seen, np.zeros(2) if shift is None else shift


def _cuts_along(source: Source, track: _Track, size: int, known: Sequence[Cut]) -> list[Cut]:
    """Return the cuts along a track of sums of `size` frames, beside those that are known."""
    found: list[Cut] = []
    for outlier in _outliers(track, size, SMALLEST_PX / binning_of(source)):
        between = FrameSpan(track.spans[outlier.before].start, track.spans[outlier.after].stop)
        if any(between.start <= cut.frame < between.stop for cut in known):
            continue
        held_out = _Sides.of(source, track, outlier)
        path = held_out.informed(_Path.of(track, outlier))
        proof = held_out.proof(path, replace(path, jump=np.zeros(2)))
        if proof < _SURE or np.linalg.norm(path.jump) * binning_of(source) < SMALLEST_PX:
            continue
        dark = _dark_frames(source, between) if len(between) > 3.5 * size else None
        if dark is not None:
            found.append(Cut((dark.start + dark.stop) // 2, path.jump * binning_of(source), outlier.sigmas, dark))
        elif (cut := _located(source, between, held_out.template(path), path)) is not None:
            found.append(cut)
    return found


def _outliers(track: _Track, size: int, smallest: float) -> list[_Outlier]:
    """Return the shifts that are outliers, each the largest around it.

    The frame of a jump lies in some sum, so that the shift from the sum before to that after is compared with the motion before
    and after. A shift between the two is that of a turn. Where sums without light lie between, the next sum is the one after.
    """
    centres, places = track.centres, track.beyond
    velocities = np.diff(places, axis=0) / np.diff(centres)[:, None]
    before = np.arange(1, len(centres) - 3)
    gap = centres[before + 1] - centres[before] > 1.5 * size
    after = before + np.where(gap, 1, 2)
    tracked = gap | (centres[after] - centres[before] <= 2.5 * size)
    before, after = before[tracked], after[tracked]
    frames = (centres[after] - centres[before])[:, None]
    unexplained = _beyond(places[after] - places[before], velocities[before - 1] * frames, velocities[after] * frames)
    # Over a longer time, the motion may change by more.
    sizes = np.linalg.norm(unexplained, axis=1) * np.minimum(1, 2 * size / frames[:, 0])
    return [_Outlier(int(before[index]), int(after[index]), sigmas) for index, sigmas in _outstanding(sizes, smallest)]


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


@dataclass(frozen=True, slots=True)
class _Sides:
    """Frames before and after an outlier, beyond the sums that suggest it. Even ones make a template, odd ones are held out."""

    frames: NDArray[np.integer]  # (T,) their numbers
    after: BoolArray  # (T,) which of them come after
    images: FloatArray  # (T, h, w) their binned pixels
    n_pixels: int  # whose mean a binned pixel is

    @classmethod
    def of(cls, source: Source, track: _Track, outlier: _Outlier) -> _Sides:
        """Read the frames."""
        numbers = [each for each in _beside(track, outlier) if each not in (outlier.before, outlier.after)]
        spans = [track.spans[number] for number in numbers]
        frames = [FrameSpan(frame, frame + 1) for span in spans for frame in range(span.start, span.stop)]
        after = np.repeat(np.asarray(numbers) > outlier.after, [len(span) for span in spans])
        images = np.array([span_image(source, frame) for frame in frames])
        return cls(np.array([frame.start for frame in frames]), after, images, binning_of(source) ** 2)

    @property
    def _even(self) -> BoolArray:
        return np.asarray(self.frames % 2 == 0)

    def template(self, path: _Path) -> FluxImage:
        """Return the mean of the even frames along a path: (h, w); NaN beyond their borders."""
        return self._mean(path, self._even)

    def proof(self, path: _Path, smooth: _Path) -> float:
        """Return how much likelier the odd frames are along a path than along a smooth one, in standard deviations.

        Each of both makes its own template of the even frames.
        """
        templates = [(self.template(each), each) for each in (path, smooth)]
        likelihoods = np.zeros(2)
        for index in np.flatnonzero(~self._even):
            frame, share = self.frames[index], float(self.after[index])
            expected = np.array([_moved(template, each.at(frame, share)) for template, each in templates])
            likelihoods += _log_likelihoods(self.images[index], expected, self.n_pixels)
        return float(np.sqrt(2 * max(likelihoods[0] - likelihoods[1], 0.0)))

    def informed(self, path: _Path) -> _Path:
        """Return a path without what jumps along a direction in which one of the sides has no texture.

        The product of gradients of two images with independent noise is the information of a shift, without that noise.
        """
        covariance, best = np.zeros((2, 2)), 0.0
        for side in (~self.after, self.after):
            means = (self._mean(path, side & parity) for parity in (self._even, ~self._even))
            first, second = (gradient_of(mean)[::-1] for mean in means)  # along x and y: (2, h, w)
            seen = np.isfinite(first + second).all(axis=0)
            information = first[:, seen] @ second[:, seen].T
            values, directions = np.linalg.eigh((information + information.T) / 2)
            covariance += (directions / np.maximum(values, 1e-12)) @ directions.T
            best = max(best, float(values[-1]))
        values, directions = np.linalg.eigh(covariance)
        known = directions[:, values * _INFORMED * best < 1]
        return replace(path, jump=known @ (known.T @ path.jump))

    def _mean(self, path: _Path, chosen: BoolArray) -> FluxImage:
        """Average chosen frames, taken back along a path: (h, w); NaN beyond their borders."""
        chosen_frames = zip(self.images[chosen], self.frames[chosen], self.after[chosen], strict=True)
        moved = [_moved(image, -path.at(frame, float(after))) for image, frame, after in chosen_frames]
        seen = np.isfinite(moved)
        mean = np.where(seen, moved, 0).sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
        smooth = cv2.GaussianBlur(mean.astype(np.float32), (0, 0), _BLUR_PX)
        return np.where(seen.any(axis=0), smooth, np.float32(np.nan))


def _located(source: Source, between: FrameSpan, template: FluxImage, path: _Path) -> Cut | None:
    """Find the first frame after a jump; None if a fast motion explains the frames as well.

    The log likelihood of each frame is that of its residual from a template, seen from the path before the jump, from that
    after, and from positions between. A jump takes the image from the one to the other at once, a fast motion in some frames.
    """
    frames = range(between.start, between.stop)
    likelihood = np.empty((len(frames), _STEPS + 1))
    for row, frame in enumerate(frames):
        image = binned_mean(source, FrameSpan(frame, frame + 1))
        expected = [_moved(template, path.at(frame, share)) for share in np.linspace(0, 1, _STEPS + 1)]
        likelihood[row] = _log_likelihoods(image, np.array(expected), binning_of(source) ** 2)
    jump, frame, share = _likeliest(likelihood, 0)
    short, *motions = (_likeliest(likelihood, ramp)[0] for ramp in (_SHORT_RAMP, *_RAMPS))
    sigmas = np.sqrt(2 * max(jump - max(motions), 0.0))
    cut = Cut(frames[min(frame, len(frames) - 1)], share * path.jump * binning_of(source), float(sigmas))
    return None if sigmas < _SURE or short > jump or cut.size_px < SMALLEST_PX else cut


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _Path:
    """A path of the image with a jump: the motion that was found, a cubic polynomial of time beyond that, and a step."""

    first: int  # the first of T frames
    followed: FloatArray  # (T, 2) the motion that was found
    middle: float  # the instant around which time is counted
    scale: float  # frames of a unit of time
    coefficients: FloatArray  # (4, 2) of the polynomial, in binned px
    jump: FloatArray  # (2,) the step

    @classmethod
    def of(cls, track: _Track, outlier: _Outlier) -> _Path:
        """Fit the path to the sums on both sides of an outlier."""
        numbers = _beside(track, outlier)
        centres, after = track.centres[numbers], np.asarray(numbers) >= outlier.after
        middle = float(track.centres[[outlier.before, outlier.after]].mean())
        scale = float(np.abs(centres - middle).max())
        equations = np.column_stack([_powers((centres - middle) / scale), after])
        # The template shows what the middle of the path sees.
        followed = track.followed - track.followed[round(middle) - track.first]
        solution = np.linalg.lstsq(equations, track.beyond[numbers] - track.beyond[outlier.before])[0]
        return cls(
            first=track.first, followed=followed, middle=middle, scale=scale, coefficients=solution[:-1], jump=solution[-1]
        )

    def at(self, frame: int, share: float) -> FloatArray:
        """Return where the image is in a frame after a share of the jump: (2,) in binned px."""
        beyond = _powers(np.array([(frame - self.middle) / self.scale]))[0] @ self.coefficients
        return np.asarray(self.followed[frame - self.first] + beyond + share * self.jump)


def _powers(times: FloatArray) -> FloatArray:
    return np.asarray(times[:, None] ** np.arange(4))


def _beside(track: _Track, outlier: _Outlier) -> list[int]:
    """Return the numbers of the sums before and after an outlier."""
    first, last = max(0, outlier.before - _SIDE), min(len(track.spans), outlier.after + _SIDE + 1)
    return [*range(first, outlier.before + 1), *range(outlier.after, last)]


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
    expected, observed = expected[:, seen], image[seen]
    variance = np.maximum(expected.mean(axis=0), _NOISE_FLOOR) / n_pixels
    return np.asarray(-0.5 * ((observed - expected) ** 2 / variance).sum(axis=1))


def _likeliest(likelihood: FloatArray, ramp: int) -> tuple[float, int, float]:
    """Return the log likelihood of the likeliest motion that takes `ramp` frames between the paths, its middle, and its share.

    `likelihood` is (T, steps + 1), that of each frame from the old path to the new one. Of a jump, whose ramp is 0, the middle
    is its first frame. Paths are not exact: a motion may begin and end up to a quarter of the way from them.
    """
    n_frames, steps = likelihood.shape[0], likelihood.shape[1] - 1
    frames, middles = np.arange(n_frames), np.arange(n_frames + 1)
    passed = frames + 0.5 - middles[:, None]
    share = (passed > 0).astype(float) if ramp == 0 else np.clip(passed / ramp + 0.5, 0, 1)
    found = []
    for first, last in product(range(steps // 4 + 1), range(steps - steps // 4, steps + 1)):
        total = likelihood[frames, np.rint(first + share * (last - first)).astype(int)].sum(axis=1)
        found.append((float(total.max()), int(total.argmax()), (last - first) / steps))
    return max(found)
