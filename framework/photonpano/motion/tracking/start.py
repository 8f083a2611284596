"""The speed of the image before the first level, from sums of a few frames, whose shifts are too small to be mistaken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.geometry import translation
from photonpano.locating import Follows, correlation_peaks, correlation_surface
from photonpano.merging import binning_of
from photonpano.motion.pairs import lengths_of
from photonpano.motion.timeline import Timeline
from photonpano.motion.tracking.spans import (
    SHORTEST,
    Spectrum,
    following,
    noise_of_difference,
    shifted,
    span_image,
    spectra_of,
    stabilised,
)
from photonpano.robust import robust_std
from photonpano.values import FloatArray, FrameSpan, Group

_SPANS = 16  # a window is divided into 16 spans: between two of them the image moves by a sixteenth of a group's motion blur
_PEAK_PX = 1.0  # standard deviation of the peak of the phase correlation, in binned pixels
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


@dataclass(frozen=True, slots=True, eq=False)
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
    return StartingMotion(instants[steady], velocities[steady], alternatives[steady], rivals[steady], 1.5 * length)


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
    surface = correlation_surface((spectra[1:] * spectra[:-1].conj()).sum(axis=0), shape, _PEAK_PX)
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
