"""Summarise a capture before any motion is known: its flux, how fast its image moves, and when it is back where it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from photonpano.contracts.protocols import Source
from photonpano.errors import InputError
from photonpano.execution.threads import in_order
from photonpano.merging import binned_mean, binning_of
from photonpano.motion.tracking import (
    SHORTEST,
    following,
    noise_of_difference,
    shifted,
    shifts_between,
    span_image,
    spectra_of,
    stabilised,
)
from photonpano.values import CaptureSummary, FloatArray, FluxImage, FrameSpan

_PLACES = 12  # where the speed is measured, evenly spaced over the capture
# Lengths of the spans that are summed, in frames, from the shortest to the longest that is tried.
_SPANS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
_SPANS_IN_CAPTURE = 6  # at least
_LARGE_SHIFT_PX = 2.0  # shift that is exact enough, in binned pixels
# The three shifts of a place agree within 1.5 binned pixels. Shifts of pure noise agree by chance at fewer than 1 in 100
# places.
_TOLERANCE_PX = 1.5
# To find a capture without light, or a saturated one, 16 frames at each of 16 places are summed.
_CHECKED_PLACES, _CHECKED_FRAMES = 16, 16
# Whether the image returns is read from this many sums all over the capture, of this many frames at most. They are shorter in
# light: this many photons in a binned pixel are enough.
_SUMS, _LONGEST_SUM, _SUMMED_PHOTONS = 256, 16, 2.0
_LEAST_LAGS = 8  # sums in a quarter of the capture, within which a return is looked for
_PARTS = 9  # the likeness of sums is averaged over each of this many parts of the capture, to know its scatter
_RETURNED = 6.0  # least rise of the likeness, in standard errors over the parts: that of photon noise is below 5
_RETURN_PX = 1.0  # the image returns from farther away than this


class _Speed(NamedTuple):
    """The speed at one place, in px per frame, and the length of the spans that it was measured with, in frames."""

    px: float
    frames: int


def summarise(source: Source, threads: int = 1) -> CaptureSummary:
    """Measure flux and speed at 12 places of a capture, whatever the number of threads.

    At each place the frames of three consecutive spans are summed, and phase correlation gives the shifts between the three
    sums. The spans are lengthened until the shifts agree and are large enough to be exact: short spans are too noisy in the
    dark, and long spans blur a fast motion.
    """
    n_frames = source.info.n_frames
    lengths = [length for length in _SPANS if SHORTEST[source.info.kind] <= length <= n_frames // _SPANS_IN_CAPTURE]
    if not lengths:
        flux = _mean_flux(source, [binned_mean(source, source.info.span)], n_frames)
        return CaptureSummary(flux, None, f"{n_frames} frames are too few to estimate a motion")
    centres = ((np.arange(_PLACES) + 0.5) / _PLACES * n_frames).tolist()
    places = list(in_order(lambda centre: _measure(source, centre, lengths), centres, threads))
    flux = float(np.mean([flux for flux, _ in places]))
    speeds = sorted((speed for _, speed in places if speed is not None), key=lambda speed: -speed.px)
    away_frames = _away_frames(source, flux, threads)
    if len(speeds) < 2:  # one may agree by chance
        return CaptureSummary(flux, None, f"no motion was found at any of {_PLACES} places", away_frames=away_frames)
    how = f"the second fastest of {len(speeds)} places, from sums of {speeds[1].frames} frames"
    return CaptureSummary(flux, speeds[1].px, how, away_frames=away_frames)


def _away_frames(source: Source, flux: float, threads: int) -> float | None:
    """Return after how many frames an image that returns is farthest from where it was; None if it does not return.

    The likeness of two sums is the product of their spectra. Averaged over all sums that are some frames apart, it shows what
    moves in the dark, where no two sums do: it falls while the image moves away, and rises again as it comes back. An image
    that moves on never makes it rise.
    """
    n_frames, binning = source.info.n_frames, binning_of(source)
    step = max(1.0, n_frames / _SUMS)
    enough = math.ceil(_SUMMED_PHOTONS / max(flux * binning**2, 1e-9))
    length = max(1, min(int(step), _LONGEST_SUM, enough))
    starts = np.arange(0, n_frames - length + 1, step).astype(int).tolist()
    if len(starts) // 4 < _LEAST_LAGS:
        return None
    images = list(in_order(lambda start: span_image(source, FrameSpan(start, start + length)), starts, threads))
    spectra = spectra_of([image / max(float(image.mean()), 1e-9) for image in images])
    flat = spectra.reshape(len(spectra), -1)
    products = (flat @ flat.conj().T).real
    first, lags = np.arange(len(flat) * 3 // 4), np.arange(1, len(flat) // 4)
    likeness = np.array([products[part[:, None], part[:, None] + lags].mean(axis=0) for part in np.array_split(first, _PARTS)])
    # What a shift along x or y would take from it.
    height, width = images[0].shape
    cycles = _RETURN_PX / binning * np.fft.fftfreq(height)[:, None], _RETURN_PX / binning * np.fft.rfftfreq(width)
    lost = 1 - sum(np.cos(2 * np.pi * each) for each in cycles) / 2
    least = max(float((lost * (spectra[:-1] * spectra[1:].conj()).real).sum(axis=(1, 2)).mean()), 0.0)
    rises = likeness[:, None, :] - likeness[:, :, None] - least
    errors = rises.std(axis=0, ddof=1) / math.sqrt(_PARTS)
    # Few parts know their scatter badly, and that of photon noise is the same at all lags.
    errors = np.maximum(errors, np.median(errors))
    returned = np.flatnonzero(np.triu(rises.mean(axis=0) > _RETURNED * errors, 1).any(axis=0))
    return float(step * lags[likeness.mean(axis=0)[: returned[0]].argmin()]) if len(returned) else None


def _measure(source: Source, centre: float, lengths: Sequence[int]) -> tuple[float, _Speed | None]:
    """Return the mean flux around an instant, and the speed there if it was found."""
    n_frames = source.info.n_frames
    binning = binning_of(source)
    speed = None
    for length in lengths:
        start = int(np.clip(centre - 1.5 * length, 0, n_frames - 3 * length))
        spans = (FrameSpan(first, first + length) for first in range(start, start + 3 * length, length))
        means = [binned_mean(source, span) for span in spans]
        images = [stabilised(source, mean, length) for mean in means]
        centred = [np.nan_to_num(image - np.nanmean(image)) for image in images]
        shift = _majority_shift(centred, noise_of_difference(source, length))
        if shift is not None:
            speed = _Speed(float(np.linalg.norm(shift)) * binning / length, length)
            if np.linalg.norm(shift) >= _LARGE_SHIFT_PX:
                break
    return _mean_flux(source, means, 3 * length), speed


def _majority_shift(images: Sequence[FluxImage], noise: float) -> FloatArray | None:
    """Return the shift from each of three images to the next that most of the image follows; None if the shifts do not agree.

    An object with strong contrast has the highest peak of the correlation even if it is small. So where a part of the image
    does not follow the shift, that part is correlated by itself, and the larger part decides. `images` have uniform noise,
    `noise` is the variance of the difference of two of them.
    """
    shift = _common_shift(images)
    if shift is None:
        return None
    part = following(images[0], shifted(images[1], shift), noise)
    if not part.suspect:
        return shift
    other = _common_shift(images, part.rest)
    if other is None or np.linalg.norm(other - shift) < _TOLERANCE_PX:
        return shift
    return other if following(images[0], shifted(images[1], other), noise).more_than(part) else shift


def _common_shift(images: Sequence[FluxImage], weight: FluxImage | None = None) -> FloatArray | None:
    """Return the shift (x, y) from each of three images to the next, in their pixels; None if the shifts do not agree."""
    if not all(np.ptp(image) for image in images):
        return None
    spectra = spectra_of(images, weight)
    first, second, both = shifts_between(spectra[[0, 1, 0]], spectra[[1, 2, 2]], images[0].shape)
    if first is None or second is None or both is None:
        return None
    if max(np.linalg.norm(second - first), np.linalg.norm(both - first - second)) > _TOLERANCE_PX:
        return None
    return both / 2


def _mean_flux(source: Source, means: Sequence[FluxImage], n_frames: int) -> float:
    """Return the flux, averaged over the pixels, of mean counts that `n_frames` frames were summed for."""
    flux = source.response.flux(np.mean(means, axis=0), float(n_frames * binning_of(source) ** 2))
    return float(np.nanmean(flux))


def require_photons(source: Source) -> None:
    """Raise an `InputError` if 256 frames all over the capture are all dark, or all lit or saturated."""
    valid, spans = source.valid, source.info.spread(_CHECKED_PLACES, _CHECKED_FRAMES)
    n_frames = sum(map(len, spans))
    mean_count = sum(source.counts(span)[valid] for span in spans) / np.float32(n_frames)
    none, most = source.response.mean_count(np.array([0, np.inf], np.float32)).tolist()
    binary = source.info.kind == "binary"
    if mean_count.max() <= none:
        raise InputError(
            f"no pixel is {'lit' if binary else 'brighter than black'} in any of {n_frames} frames sampled all over the "
            "capture; check that the file is the right one, and that the lens was open"
        )
    if mean_count.min() >= most:
        raise InputError(
            f"every pixel is {'lit' if binary else 'saturated'} in all of {n_frames} frames sampled all over the capture, "
            "so the flux cannot be estimated; check the layout of the file, or expose less"
        )


def saturated_share(source: Source) -> float:
    """Return the fraction of the valid pixels that have their highest value in all of 256 frames: their flux is unknown."""
    highest = source.response.mean_count(np.array([np.inf], np.float32)).item()
    spans = source.info.spread(_CHECKED_PLACES, _CHECKED_FRAMES)
    full = np.logical_and.reduce([source.counts(span) >= highest * len(span) for span in spans])
    return float(full[source.valid].mean())
