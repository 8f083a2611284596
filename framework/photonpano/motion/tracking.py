"""Track the image by sums of a few frames in binned pixels: its speed before the first level, and where registrations start."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft

from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.geometry import corners, inverse, normalised, transform_points, translation
from photonpano.locating import Follows, correlation_peaks, correlation_surface, follows, shift_of_spectra
from photonpano.merging import binned_mean, binning_of
from photonpano.motion.level import FrameHomography, Timeline
from photonpano.motion.pairs import lengths_of
from photonpano.photometry import hann_window
from photonpano.robust import robust_std
from photonpano.values import FloatArray, FluxImage, FrameSpan, Group, Homography

SHORTEST = {"binary": 4, "intensity": 1}  # frames of the shortest span: sums of fewer binary frames are mostly noise
PEAK_PX = 1.5  # standard deviation of the peak of the phase correlation, in binned pixels
DARK = 0.2  # sums, and frames, with less than this share of the usual light show nothing
_SPANS = 16  # a window is divided into 16 spans: between two of them the image moves by a sixteenth of a group's motion blur
_SUMMED_PEAK_PX = 1.0  # the same, where the correlations of several spans are summed
# Least height of a peak, in standard deviations of the correlation: of noise alone, the highest of 8,000 values reaches 5.
_SIGNIFICANT = 7.0
_RIVAL = 0.6  # least height of the peak of a hypothesis, relative to the highest
_LEAST_EXTENT = 0.05  # a part of the image that moves otherwise is a hypothesis if its extent is this share of the other part's
_DISTINCT_PX = 4.0  # least difference of two motions over a window, in binned pixels
# Shift between spans that is exact enough, in binned pixels; spans are doubled until then.
_EXACT_PX = 4.0
_TRACKED_PX = 2.0  # a peak of doubled spans lies within this many binned pixels of twice the shift of single ones
_CONTINUITY_PX = 1.0  # standard deviation of the change of a shift, in binned pixels, from one window to the next
_CONTINUITY_SHARE = 0.3  # its largest value, relative to the difference of two hypotheses
_SLOWER = 3.0  # motions that are faster than the slowest by this factor are left out
# A window is an outlier if it differs from the median of its nearest windows by this many times what others do.
_NEAR_WINDOWS, _LEAP = 6, 6.0
_FAR = 1e6  # frames beyond the first and last instant within which the velocity is constant
_TIE = 4.0  # difference of the log likelihoods of hypotheses below which both are kept


Spectrum = NDArray[np.complexfloating]
_hann_window = cache(hann_window)


def span_image(source: Source, span: FrameSpan) -> FluxImage:
    """Return the mean counts of a span, binned: (h, w); where no pixel is valid, the mean of the others."""
    image = binned_mean(source, span)
    return np.nan_to_num(image, nan=float(np.nanmean(image)))


def stabilised(source: Source, mean_count: FluxImage, n_frames: float) -> FluxImage:
    """Return mean counts of binned pixels on the scale on which their noise is uniform."""
    frames = float(n_frames * binning_of(source) ** 2)
    return source.response.stabilised(source.response.flux(mean_count, frames), frames)


def noise_of_difference(source: Source, n_frames: float) -> float:
    """Return the variance of the difference of two `stabilised` images."""
    return 2 * float(source.response.stabilised_std(float(n_frames * binning_of(source) ** 2))) ** 2


def spectra_of(images: Sequence[FluxImage] | FluxImage, weight: FluxImage | None = None) -> Spectrum:
    """Return the spectra of images (S, h, w), of weighted mean 0, under a Hann window: (S, h, w // 2 + 1)."""
    window = _hann_window(images[0].shape)
    if weight is not None:
        window = window * weight
    share = window / max(float(window.sum()), 1e-12)
    return np.array([fft.rfft2(window * (image - float((share * image).sum()))) for image in images])


def shifts_between(moving: Spectrum, fixed: Spectrum, shape: tuple[int, ...]) -> list[FloatArray | None]:
    """Return the shift (x, y) of each pair of spectra, in binned pixels; None without texture."""
    pairs = zip(moving, fixed, strict=True)
    return [shift_of_spectra(before, after, shape, PEAK_PX, gaussian_peak=False) for before, after in pairs]


def shifted(image: FluxImage, shift: FloatArray) -> FluxImage:
    """Return an image seen along a shift: `shifted(p) = image(p + shift)`; NaN outside."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(image, translation(*shift)[:2], image.shape[::-1], flags=flags, borderValue=np.nan), np.float32
    )


def following(moving: FluxImage, fixed: FluxImage, noise: float) -> Follows:
    """Find the part of an image that shows the same as another one, seen along a motion.

    Both are (h, w) on the scale on which noise is uniform, NaN where nothing is seen; `noise` is the variance of their
    difference.
    """
    seen = np.isfinite(moving) & np.isfinite(fixed)
    return follows(np.nan_to_num(moving), np.nan_to_num(fixed), np.where(seen, np.float32(noise), np.float32(np.inf)))


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """Possible velocities of the image within one window."""

    velocities: FloatArray  # (P, 2) in px of a frame per frame period, likeliest first
    heights: FloatArray  # (P,) of the peaks, as shares of the highest
    px_per_frame: float  # velocity that moves the image by one binned pixel between spans
    suspect: bool = False  # whether a part of the image may move otherwise than the likeliest velocity of its peaks

    @property
    def apart(self) -> float:
        """Least difference of two of the velocities; infinite for a single one."""
        differences = np.linalg.norm(self.velocities[:, None] - self.velocities, axis=-1)
        return float(differences[differences > 0].min(initial=np.inf))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StartingMotion:
    """A motion without rotation, from the velocity of the image in windows of the length of a group."""

    instants: FloatArray  # (N,) centres of the windows in which the velocity was found
    velocities: FloatArray  # (N, 2) of the image there, in px of a frame per frame period
    alternatives: FloatArray  # (N, 2) velocities that are as likely; NaN where there is none
    rivals: FloatArray  # (N, 2) velocities of another part of the image, if less likely; NaN where none was found
    reach: float  # frames from the nearest of these instants within which the motion is known
    timeline: Timeline | None = None  # where the image jumps; None if it is not known to

    def between(self, moving: float, fixed: float) -> FloatArray | None:
        """Return the homography from the frame at one instant to that at another: (3, 3); None where it is not known."""
        points = np.linspace(fixed, moving, 9)
        if np.abs(points[:, None] - self.instants).min(axis=1).max() > self.reach:
            return None
        there, here = self._travelled(self.velocities, np.array([fixed, moving]))
        shift = here - there
        if self.timeline is not None:
            shift += self.timeline.shift_between(fixed, moving)
        return translation(*-shift)

    def at(self, frame_indices: ArrayLike) -> FloatArray:
        """Return the shifts of N instants to the frame of the first known one, as homographies: (N, 3, 3)."""
        instants = np.asarray(frame_indices, dtype=np.float64)
        found = np.tile(np.eye(3), (len(instants), 1, 1))
        found[:, :2, 2] = -self._travelled(self.velocities, instants)
        return found

    def alternative_px(self, moving: float, fixed: float) -> float:
        """Return how far from that motion an equally likely one is, in px; 0 if there is none."""
        differences = np.nan_to_num(self.alternatives - self.velocities)
        there, here = self._travelled(differences, np.array([fixed, moving]))
        return float(np.linalg.norm(here - there))

    def _travelled(self, velocities: FloatArray, instants: FloatArray) -> FloatArray:
        """Return the integral of (N, 2) velocities from the first of these instants to others: (M, 2)."""
        far = np.concatenate([[self.instants[0] - _FAR], self.instants, [self.instants[-1] + _FAR]])
        velocities = np.pad(velocities, ((1, 1), (0, 0)), mode="edge")
        # The trapezoid rule is exact, since velocities are linear between these instants.
        parts = np.diff(far)[:, None] * (velocities[1:] + velocities[:-1]) / 2
        travelled = np.concatenate([np.zeros((1, 2)), np.cumsum(parts, axis=0)])
        before = np.clip(np.searchsorted(far, instants) - 1, 0, len(far) - 2)
        here = np.stack([np.interp(instants, far, each) for each in velocities.T], axis=1)
        return np.asarray(
            travelled[before] + (instants - far[before])[:, None] * (velocities[before] + here) / 2 - travelled[1]
        )


def starting_motion(source: Source, groups: Sequence[Group], context: Context) -> StartingMotion | None:
    """Measure the velocity of the image all over a capture, before any motion is known; None if no window has a peak.

    The capture is divided into windows of the length of a group, and each of them into short spans of frames. The phase
    correlations of successive spans are averaged over the window; their peaks are the hypotheses. Of several, continuity from
    window to window decides.
    """
    n_frames = source.info.n_frames
    length = min(n_frames, max(2 * SHORTEST[source.info.kind], round(float(np.median(lengths_of(groups))))))
    if length < SHORTEST[source.info.kind]:
        return None
    starts = np.rint(np.linspace(0, n_frames - length, max(1, n_frames // length))).astype(int).tolist()
    found = list(context.in_order(partial(_hypotheses, source, length), starts))
    found = list(context.in_order(partial(_with_those_near, source, length, starts, found), range(len(starts))))
    known = [(start + (length - 1) / 2, each) for start, each in zip(starts, found, strict=True) if each is not None]
    if not known:
        return None
    velocities, alternatives, rivals = _continuous([each for _, each in known])
    instants, px_per_frame = np.array([instant for instant, _ in known]), max(each.px_per_frame for _, each in known)
    steady = _steady(velocities, px_per_frame)
    return StartingMotion(
        instants=instants[steady],
        velocities=velocities[steady],
        alternatives=alternatives[steady],
        rivals=rivals[steady],
        reach=1.5 * length,
    )


def _hypotheses(source: Source, length: int, start: int, offered: Sequence[FloatArray] = ()) -> Hypotheses | None:
    """Return the velocities that a window, its first frame `start`, may have; None if no peak is significant.

    Where a part of the image does not follow the highest peak, its own velocity is a hypothesis, too, and so are those
    `offered`, in px per frame period. The heights of both are then the extents of these parts, for an object with strong
    contrast makes the highest peak even if it is small.
    """
    short = max(SHORTEST[source.info.kind], length // _SPANS)
    spans = [FrameSpan(first, first + short) for first in range(start, start + length - short + 1, short)]
    binned = np.stack([span_image(source, span) for span in spans])
    found = _velocities(binned)
    if found is None:
        return None
    shifts, heights, doubled = found
    heights, px_per_frame = heights / heights[0], binning_of(source) / short
    part = _following(source, binned, short, shifts[0])
    if part.suspect:
        of_rest = _velocities(binned, part.rest)
        rivals = [each / px_per_frame for each in offered] + ([] if of_rest is None else [of_rest[0][0]])
        others = [_following(source, binned, short, rival) for rival in rivals]
        extents = [(part.extent_beyond(other), other.extent_beyond(part)) for other in others]
        distinct = [np.linalg.norm(rival - shifts[0]) * len(binned) > _DISTINCT_PX for rival in rivals]
        shares = [
            other / max(own, other, 1e-12) if apart else 0.0 for (own, other), apart in zip(extents, distinct, strict=True)
        ]
        if shares and max(shares) > _LEAST_EXTENT:
            best = int(np.argmax(shares))
            own, other = np.maximum(extents[best], _LEAST_EXTENT * max(extents[best])) / max(extents[best])
            shifts, heights = np.vstack([rivals[best], shifts]), np.append(other, own * heights)
    order = np.argsort(-heights, kind="stable")
    shifts, heights = shifts[order], heights[order]
    sizes = np.linalg.norm(shifts, axis=1) * doubled
    slow = sizes <= _SLOWER * max(1.0, sizes.min())
    return Hypotheses(shifts[slow] * px_per_frame, heights[slow], px_per_frame / doubled, part.suspect)


def _with_those_near(
    source: Source, length: int, starts: Sequence[int], found: Sequence[Hypotheses | None], index: int
) -> Hypotheses | None:
    """Return the hypotheses of a window; those of its neighbours, too, where a part moves otherwise, by a motion not found."""
    here = found[index]
    if here is None or not here.suspect or len(here.velocities) > 1:
        return here
    near = [each for each in (*found[max(0, index - 1) : index], *found[index + 1 : index + 2]) if each is not None]
    return _hypotheses(source, length, starts[index], [velocity for each in near for velocity in each.velocities])


def _following(source: Source, binned: NDArray[np.float32], n_frames: int, shift: FloatArray) -> Follows:
    """Find the part of a window that follows a shift between successive spans: compare its first third with its last.

    `binned` (S, h, w) are means of spans of `n_frames`; the shift (x, y) is in binned pixels.
    """
    middle, third = (len(binned) - 1) / 2, max(1, len(binned) // 3)
    aligned = [shifted(image, shift * (index - middle)) for index, image in enumerate(binned)]
    means = (np.mean(part, axis=0) for part in (aligned[:third], aligned[-third:]))
    first, last = (stabilised(source, mean, n_frames * third) for mean in means)
    return following(first, last, noise_of_difference(source, n_frames * third))


def _velocities(
    images: NDArray[np.float32], weight: NDArray[np.float32] | None = None
) -> tuple[FloatArray, FloatArray, int] | None:
    """Return the (P, 2) shifts between successive images (S, h, w), the heights of the peaks, and how many were summed.

    Images are summed in twos until a peak is significant; then on, to make the shift exact, as long as the peak is found again.
    """
    spectra, shape, doubled = spectra_of(images, weight), images.shape[1:], 1
    while len(spectra) >= 2:
        surface = _surface(spectra, shape)
        if surface is not None and surface.max() >= _SIGNIFICANT:
            shifts, heights = correlation_peaks(surface, _RIVAL)
            return _refined(spectra, shape, shifts) / doubled, heights, doubled
        spectra, doubled = _summed_in_twos(spectra), 2 * doubled
    return None


def _refined(spectra: Spectrum, shape: tuple[int, ...], shifts: FloatArray) -> FloatArray:
    """Return (P, 2) shifts more exactly, from sums of more spans, whose shifts are larger."""
    refined, doubled, moving = shifts.copy(), 1, np.ones(len(shifts), dtype=bool)
    while len(spectra) >= 4 and moving.any():
        spectra, doubled = _summed_in_twos(spectra), 2 * doubled
        moving &= np.linalg.norm(refined, axis=1) * doubled < 2 * _EXACT_PX
        surface = _surface(spectra, shape)
        if surface is None:
            break
        peaks, heights = correlation_peaks(surface, 0.0, most=32)
        peaks = peaks[heights >= _SIGNIFICANT]
        for index in np.flatnonzero(moving):
            distances = np.linalg.norm(peaks - doubled * refined[index], axis=1)
            moving[index] = bool(len(peaks)) and distances.min() <= _TRACKED_PX
            if moving[index]:
                refined[index] = peaks[distances.argmin()] / doubled
    return refined


def _surface(spectra: Spectrum, shape: tuple[int, ...]) -> FloatArray | None:
    """Return the phase correlation of successive images, in standard deviations of its noise."""
    surface = correlation_surface((spectra[1:] * spectra[:-1].conj()).sum(axis=0), shape, _SUMMED_PEAK_PX)
    # Robust, since a scene that repeats has many peaks.
    return None if surface is None else surface / max(robust_std(surface), 1e-12)


def _summed_in_twos(spectra: Spectrum) -> Spectrum:
    even = len(spectra) // 2 * 2
    return np.asarray(spectra[:even:2] + spectra[1:even:2])


def _continuous(windows: Sequence[Hypotheses]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Choose one hypothesis of each window, so that together they are the likeliest (Viterbi 1967).

    A hypothesis is the likelier the higher its peak, and the nearer it is to that of the next window. Of the first window, slow
    ones are likelier, by the square of the speed: before it is known, its order of magnitude may be any.

    Return (N, 2) velocities, those that are as likely, and the likeliest of all others; NaN where there is none.
    """
    scores = [np.log(each.heights) for each in windows]
    scores[0] = scores[0] - 2 * np.log(np.maximum(np.linalg.norm(windows[0].velocities, axis=1), windows[0].px_per_frame))
    links = [_link(before, after) for before, after in pairwise(windows)]
    forward, backward = [scores[0]], [np.zeros(len(scores[-1]))]
    for link, score in zip(links, scores[1:], strict=True):
        forward.append(score + (forward[-1][:, None] + link).max(axis=0))
    for link, score in zip(reversed(links), reversed(scores[1:]), strict=True):
        backward.append((link + score + backward[-1]).max(axis=1))
    velocities = np.empty((len(windows), 2))
    alternatives, rivals = np.full((2, len(windows), 2), np.nan)
    for index, (each, total) in enumerate(zip(windows, map(np.add, forward, reversed(backward)), strict=True)):
        best, *others = np.argsort(-total, kind="stable")
        velocities[index] = each.velocities[best]
        if others and total[best] - total[others[0]] < _TIE:
            alternatives[index] = each.velocities[others[0]]
        if others:
            rivals[index] = each.velocities[others[0]]
    return velocities, alternatives, rivals


def _steady(velocities: FloatArray, px_per_frame: float) -> NDArray[np.integer]:
    """Return which windows are no outliers: few among others, that move by much more than these change."""
    every = np.arange(len(velocities))
    if len(every) <= _NEAR_WINDOWS:
        return every
    first = np.clip(every - _NEAR_WINDOWS // 2, 0, len(every) - 1 - _NEAR_WINDOWS)
    near = first[:, None] + np.arange(_NEAR_WINDOWS + 1)
    others = near[near != every[:, None]].reshape(len(every), _NEAR_WINDOWS)
    leaps = np.linalg.norm(velocities - np.median(velocities[others], axis=1), axis=1)
    return np.flatnonzero(leaps <= max(_LEAP * float(np.median(leaps)), px_per_frame))


def _link(before: Hypotheses, after: Hypotheses) -> FloatArray:
    """Return the log likelihood of each change of velocity from one window to the next: (P, Q)."""
    change = before.velocities[:, None] - after.velocities
    std = min(_CONTINUITY_PX * max(before.px_per_frame, after.px_per_frame), _CONTINUITY_SHARE * min(before.apart, after.apart))
    return np.asarray(-np.sum((change / std) ** 2, axis=-1) / 2)


@dataclass(frozen=True, slots=True)
class Place:
    """Where an exposure lies."""

    segment: int  # number of the first exposure of those that are tied to this one
    homography: Homography  # (3, 3), pixels of its frame to those of that exposure's frame
    # (2,) shift of the middle of the image per frame period, px, along the last pair that was located; None where none was
    velocity: FloatArray | None


class Track:
    """The exposures of the first level, each tied to the nearest earlier one."""

    def __init__(
        self, start: StartingMotion | None, groups: Sequence[Group], frame_shape: tuple[int, int], places: Mapping[int, Place]
    ) -> None:
        """Take the motion that short spans show, all groups of the level, and the places of some of them."""
        self._start, self._groups = start, groups
        self._middle = corners(frame_shape).mean(axis=0)
        self.places = dict(places)  # where exposures lie, by their numbers: those that were given, and those settled since
        # of the pairs that may just as well have another motion, how far that is from the one they start at
        self.alternatives_px: dict[tuple[int, int], float] = {}

    def expected(
        self, place: Place | None, moving: int, fixed: int, hypotheses: Callable[[], Sequence[Homography]]
    ) -> FrameHomography | None:
        """Return where the registration of a pair starts: (3, 3); None if nothing is known.

        `place` is where `moving` lies, if one of its pairs was located before; `hypotheses` returns the motions that the two
        images themselves suggest, likeliest first.
        """
        there = self.places[fixed]
        if place is not None and place.segment == there.segment:
            return FrameHomography(normalised(inverse(there.homography) @ place.homography))
        instants = self._groups[moving].reference, self._groups[fixed].reference
        timeline = None if self._start is None else self._start.timeline
        if timeline is not None and timeline.is_dark_between(instants[1], instants[0]):
            return self._steadiest(hypotheses(), None, moving, fixed)
        if self._start is not None and (motion := self._start.between(*instants)) is not None:
            if alternative_px := self._start.alternative_px(*instants):
                self.alternatives_px[moving, fixed] = alternative_px
            return FrameHomography(motion)
        return self._steadiest(hypotheses(), there.velocity, moving, fixed)

    def placed(self, moving: int, fixed: int, motion: Homography) -> Place:
        """Return where an exposure lies by its motion to an earlier one."""
        there = self.places[fixed]
        velocity = self._shift(motion) / self._frames_between(moving, fixed)
        return Place(there.segment, normalised(there.homography @ motion), velocity)

    def settle(self, moving: int, place: Place | None) -> None:
        """Keep where an exposure lies; None for the first of its segment."""
        self.places[moving] = Place(moving, np.eye(3), None) if place is None else place

    def _steadiest(
        self, hypotheses: Sequence[Homography], velocity: FloatArray | None, moving: int, fixed: int
    ) -> FrameHomography | None:
        """Return the hypothesis nearest to the motion so far, or the likeliest at the start."""
        if not len(hypotheses):
            return None
        shifts = np.array([self._shift(each) for each in hypotheses])
        if velocity is None:
            if len(shifts) > 1:
                self.alternatives_px[moving, fixed] = float(np.linalg.norm(shifts[1] - shifts[0]))
            return FrameHomography(hypotheses[0])
        going_on = velocity * self._frames_between(moving, fixed)
        return FrameHomography(hypotheses[int(np.linalg.norm(shifts - going_on, axis=1).argmin())])

    def _frames_between(self, moving: int, fixed: int) -> float:
        return self._groups[moving].reference - self._groups[fixed].reference

    def _shift(self, motion: Homography) -> FloatArray:
        return np.asarray(transform_points(motion, self._middle[None])[0] - self._middle)
