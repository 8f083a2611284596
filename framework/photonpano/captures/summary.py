"""Look at a capture before any motion is known: how bright it is, and how fast its image moves."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from photonpano.errors import InputError
from photonpano.protocols import LinearlyCorrectedSource, Source
from photonpano.values import CaptureSummary, FloatArray, FluxImage, FrameSpan

_PLACES = 12
_SPANS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
"""Frames that are summed. What crosses the image in the shortest is too fast to be located by anything."""
_SHORTEST = {"binary": 4, "intensity": 1}
"""Fewer binary frames than this are noise, whose shifts may agree by chance."""
_SHARE = 6
"""No span is longer than this part of the capture."""
_SIDE = 64
"""Pixels are added up until the shorter side has about so many: fewer have less noise, and tell shifts less exactly."""
_EXACT = 2.0
"""A shift by so many of these larger pixels is told exactly enough."""
_DETAIL = 1.5
"""Standard deviation of the Gaussian that the peak of a phase correlation becomes, in larger pixels."""
_ALIKE = 1.5
"""Shifts that differ by less than this, in larger pixels, agree. Those between images of noise alone lie anywhere, so that two
agree by chance once in some hundreds of times, and three hardly ever."""


_CHECKED_PLACES, _CHECKED_FRAMES = 16, 16
"""Frames are checked at 16 places, 16 at each."""


@dataclass(frozen=True, slots=True)
class _Speed:
    """What one place tells: the speed in px a frame, and by sums of how many frames."""

    px: float
    frames: int


def summarise(source: Source, threads: int = 1) -> CaptureSummary:
    """Measure the flux and the speed at places spread over the capture.

    At each place three spans side by side are summed, and the shifts between their images are found by phase correlation.
    Spans grow until the shifts agree, and are long enough to be exact: in the dark short spans tell nothing, and in long ones
    fast motion is a blur.

    Args:
        source: the capture.
        threads: how many places are looked at once; the result does not depend on it.
    """
    n_frames = source.info.n_frames
    lengths = [length for length in _SPANS if _SHORTEST[source.info.kind] <= length <= n_frames // _SHARE]
    if not lengths:
        flux = _mean_flux(source, [_mean_count(source, source.info.span)], n_frames)
        return CaptureSummary(flux, None, f"{n_frames} frames are too few to tell a motion")
    centres = ((np.arange(_PLACES) + 0.5) / _PLACES * n_frames).tolist()
    with ThreadPoolExecutor(threads, thread_name_prefix="probe") as pool:
        places = list(pool.map(lambda centre: _look(source, centre, lengths), centres))
    flux = float(np.mean([flux for flux, _ in places]))
    told = sorted((speed for _, speed in places if speed is not None), key=lambda speed: -speed.px)
    if len(told) < 2:  # one may agree by chance
        return CaptureSummary(flux, None, f"no motion can be told at any of {_PLACES} places")
    how = f"the second fastest of {len(told)} places, from sums of {told[1].frames} frames"
    return CaptureSummary(flux, told[1].px, how)


def _look(source: Source, centre: float, lengths: Sequence[int]) -> tuple[float, _Speed | None]:
    """Return the mean flux around an instant, and how fast the image moves there, if that can be told."""
    n_frames = source.info.n_frames
    factor = _factor(source)
    speed = None
    for length in lengths:
        start = int(np.clip(centre - 1.5 * length, 0, n_frames - 3 * length))
        spans = (FrameSpan(first, first + length) for first in range(start, start + 3 * length, length))
        means = [_mean_count(source, span) for span in spans]
        shift = _common_shift([_image(source, mean, length) for mean in means])
        if shift is not None:
            speed = _Speed(shift * factor / length, length)
            if shift >= _EXACT:
                break
    return _mean_flux(source, means, 3 * length), speed


def _common_shift(images: Sequence[FluxImage]) -> float | None:
    """Return by how much each of three images is shifted against the one before, in its pixels; None if they do not agree."""
    if not all(np.ptp(image) for image in images):
        return None
    first, second, both = (_shift(images[k], images[j]) for k, j in ((0, 1), (1, 2), (0, 2)))
    if max(np.linalg.norm(second - first), np.linalg.norm(both - first - second)) > _ALIKE:
        return None
    return float(np.linalg.norm(both)) / 2


def _factor(source: Source) -> int:
    """Return the side of a larger pixel, in px."""
    return max(1, min(source.info.frame_shape) // _SIDE)


def _mean_count(source: Source, span: FrameSpan) -> FluxImage:
    """Return the mean count of a frame of the span in larger pixels; NaN where no pixel is valid."""
    factor = _factor(source)
    height, width = (side // factor * factor for side in source.info.frame_shape)
    size = (width // factor, height // factor)
    valid = source.valid[:height, :width].astype(np.float32)
    counts = source.counts(span)
    lit = source.corrected(counts, len(span)) if isinstance(source, LinearlyCorrectedSource) else counts
    lit = lit[:height, :width] * valid
    share, summed = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (valid, lit.astype(np.float32)))
    mean = np.full(share.shape, np.nan, dtype=np.float32)
    np.divide(summed, share * len(span), out=mean, where=share > 0)
    return mean


def _mean_flux(source: Source, means: Sequence[FluxImage], n_frames: int) -> float:
    """Return the flux, averaged over the pixels, of images that were summed from so many frames together."""
    flux = source.response.flux(np.mean(means, axis=0), float(n_frames * _factor(source) ** 2))
    return float(np.nanmean(flux))


def _image(source: Source, mean_count: FluxImage, n_frames: int) -> FluxImage:
    """Return an image on the scale on which its noise is uniform, around 0."""
    frames = float(n_frames * _factor(source) ** 2)
    image = source.response.stabilised(source.response.flux(mean_count, frames), frames)
    return np.nan_to_num(image - np.nanmean(image))


def _shift(first: FluxImage, second: FluxImage) -> FloatArray:
    """Return by how much the second image is shifted, (y, x) in its pixels, by phase correlation (Kuglin and Hines 1975).

    The fine details count less, since in the dark they are noise.
    """
    height, width = first.shape
    window = cv2.createHanningWindow((width, height), cv2.CV_32F)
    moved, fixed = (np.fft.rfft2(image * window) for image in (second, first))
    power = moved * fixed.conj()
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    power *= np.exp(-2 * (np.pi * _DETAIL * frequency) ** 2) / np.maximum(np.abs(power), np.finfo(np.float32).tiny)
    surface = np.fft.irfft2(power, first.shape)
    peak = np.array(np.unravel_index(np.argmax(surface), surface.shape))
    size = np.array(surface.shape)
    shift = np.empty(2)
    for axis, step in enumerate(np.eye(2, dtype=int)):
        before, at, after = (surface[tuple((peak + k * step) % size)] for k in (-1, 0, 1))
        curvature = before - 2 * at + after
        shift[axis] = peak[axis] + ((before - after) / (2 * curvature) if curvature < 0 else 0)
    return np.asarray((shift + size / 2) % size - size / 2)


def require_photons(source: Source) -> None:
    """Look at a few frames all over the capture, and refuse one that is all dark or all lit.

    Raises:
        InputError: no pixel, or every pixel, is lit in all of them; of grey levels, all are black, or saturated.
    """
    valid, spans = source.valid, source.info.spread(_CHECKED_PLACES, _CHECKED_FRAMES)
    seen = sum(map(len, spans))
    mean_count = sum(source.counts(span)[valid] for span in spans) / np.float32(seen)
    none, most = source.response.mean_count(np.array([0, np.inf], np.float32)).tolist()
    binary = source.info.kind == "binary"
    if mean_count.max() <= none:
        raise InputError(
            f"no pixel is {'lit' if binary else 'brighter than black'} in any of {seen} frames looked at all over the capture; "
            "check that the file is the right one, and that the lens was open"
        )
    if mean_count.min() >= most:
        raise InputError(
            f"every pixel is {'lit' if binary else 'saturated'} in all of {seen} frames looked at all over the capture, "
            "so that no flux can be told; check the layout of the file, or expose less"
        )


def saturated_share(source: Source) -> float:
    """Return how many of the pixels that may be used are at their highest value in all of some hundred frames.

    Their flux is unknown.
    """
    highest = source.response.mean_count(np.array([np.inf], np.float32)).item()
    spans = source.info.spread(_CHECKED_PLACES, _CHECKED_FRAMES)
    full = np.logical_and.reduce([source.counts(span) >= highest * len(span) for span in spans])
    return float(full[source.valid].mean())
