"""Sums of short spans of frames in binned pixels: their shifts, tracks of many, and which part of a sum follows a shift."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain, islice

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from photonpano.contracts.protocols import Source
from photonpano.execution.context import Context
from photonpano.geometry import translation
from photonpano.locating import Follows, follows, shift_of_spectra
from photonpano.merging import binned_mean, binning_of
from photonpano.photometry import hann_window
from photonpano.values import FloatArray, FluxImage, FrameSpan

SHORTEST = {"binary": 4, "intensity": 1}  # frames of the shortest span: sums of fewer binary frames are mostly noise
PEAK_PX = 1.5  # standard deviation of the peak of the phase correlation, in binned pixels

Spectrum = NDArray[np.complexfloating]
_MIN_SUMS = 6  # of a track
DARK = 0.2  # sums, and frames, with less than this share of the usual light show nothing
_BLOCK = 32  # sums that are tracked in one task


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
    window = _window(images[0].shape)
    if weight is not None:
        window = window * weight
    share = window / max(float(window.sum()), 1e-12)
    return np.array([fft.rfft2(window * (image - float((share * image).sum()))) for image in images])


def shifts_between(moving: Spectrum, fixed: Spectrum, shape: tuple[int, ...]) -> list[FloatArray | None]:
    """Return the shift (x, y) of each pair of spectra, in binned pixels; None without texture. The longer list is cut off."""
    pairs = zip(moving, fixed, strict=False)
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


@cache
def _window(shape: tuple[int, ...]) -> NDArray[np.float32]:
    return hann_window(shape)


@dataclass(frozen=True, slots=True, eq=False)
class SumTrack:
    """Sums of successive frames with light, and the shifts of the image between them."""

    spans: Sequence[FrameSpan]  # (N,) of the sums, in order
    next_px: FloatArray  # (N - 1, 2) shifts from each to the next, in binned px
    second_px: FloatArray  # (N - 2, 2) shifts from each to the second next

    @property
    def centres(self) -> FloatArray:
        """(N,) instants, in frames."""
        return np.array([span.centre for span in self.spans])

    @property
    def velocities(self) -> FloatArray:
        """(N - 1, 2) mean velocity of the image from each sum to the next, in binned px per frame."""
        return np.asarray(self.next_px / np.diff(self.centres)[:, None])


def track_sums(source: Source, runs: Sequence[Sequence[FrameSpan]], context: Context) -> Iterator[SumTrack | None]:
    """Yield the track of each run of sums that show something, in order; None if they are too few."""
    blocks = [_blocks_of(spans) for spans in runs]
    parts = context.in_order(partial(_tracked_block, source), list(chain.from_iterable(blocks)))
    for spans, of_run in zip(runs, blocks, strict=True):
        light, track = _joined(spans, list(islice(parts, len(of_run))))
        lit = light > DARK * np.median(light) if len(light) else light
        if np.count_nonzero(lit) < _MIN_SUMS:
            yield None
        elif lit.all():
            yield track
        else:
            # Those without light are left out, and so are the shifts to them: once more, as few captures have any.
            left = [spans[index] for index in np.flatnonzero(lit).tolist()]
            yield _joined(left, [_tracked_block(source, block) for block in _blocks_of(left)])[1]


def _blocks_of(spans: Sequence[FrameSpan]) -> list[tuple[FrameSpan, ...]]:
    return [tuple(spans[first : first + _BLOCK + 2]) for first in range(0, len(spans), _BLOCK)]


def _joined(
    spans: Sequence[FrameSpan], parts: Sequence[tuple[FloatArray, FloatArray, FloatArray]]
) -> tuple[FloatArray, SumTrack]:
    """Return the light of each sum, (N,), and the track of all of them, from their blocks."""
    light, next_px, second_px = (np.concatenate([part[number] for part in parts] or [np.empty(0)]) for number in range(3))
    return light, SumTrack(spans, next_px, second_px)


def _tracked_block(source: Source, spans: Sequence[FrameSpan]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the light of the first 32 sums, and their shifts to the next and the second next; two further sums follow them."""
    images = [span_image(source, span) for span in spans]
    spectra = spectra_of(images)

    def shifts(skip: int) -> FloatArray:
        # An image without texture does not shift.
        found = shifts_between(spectra[:_BLOCK], spectra[skip:], images[0].shape)
        return np.array([np.zeros(2) if shift is None else shift for shift in found]).reshape(-1, 2)

    return np.array([float(np.mean(image)) for image in images[:_BLOCK]]), shifts(1), shifts(2)
