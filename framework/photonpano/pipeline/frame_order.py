"""Find frames that are not in the order in which they were taken: interlaced from two captures, or shuffled."""

from __future__ import annotations

import numpy as np
from scipy import fft

from photonpano.contracts.protocols import Source
from photonpano.merging import binned_mean, binning_of
from photonpano.motion.timeline import INTERLACED, SHUFFLED
from photonpano.motion.tracking.spans import Spectrum, shifts_between, spectra_of
from photonpano.values import Decision, FluxImage, FrameSpan

_PLACES, _SHORTEST, _FRAMES = 6, 8, 64  # spans all over the capture, and fewest and most frames of each
_UNLIKE = 0.5  # most similarity of two images, relative to that of each with itself
_REACH_PX = 6.0  # a tremor may move every second frame by this much
_SURE = 4.0  # standard deviations by which an image resembles itself
_LONGEST_WAVE = 1 / 4  # of the frame: longer waves are alike in many scenes
_TOLERANCE_PX = 1.5  # by which three shifts between three frames agree, in binned px
_FEWEST = 0.1  # share of the shifts that agree; those of noise do so once in 1,000
_FEWEST_PHOTONS = 200.0  # of a frame: between two single photons, any shift fits
_FAR = 0.05  # of the width of a frame: a jump from one frame to the next
_BACK = -0.2  # mean cosine between two jumps: 1 if the motion goes on, -0.5 where the order is random


def interlaced(source: Source) -> list[Decision]:
    """Return a decision with the share in which odd and even frames differ, if they show two images; none if not.

    The frames of four phases are summed: those two apart show the same image, even if flicker, tremor or copies tell odd from
    even frames. All four see the same motion, so that it blurs them alike.
    """
    found = []
    for span in _spans(source, _FRAMES):
        images = _frames(source, span)
        used = len(images) // 4 * 4
        if used:
            phases = np.asarray(images[:used].reshape(-1, 4, *images.shape[1:]).mean(axis=0), np.float32)
            found.append(_similarity(phases, round(_REACH_PX / binning_of(source))))
    known = [each for each in found if each is not None]
    if 2 * len(known) < max(len(found), 1) or not np.median(known) < _UNLIKE:
        return []
    return [Decision(INTERLACED, round(1 - float(np.median(known)), 2), "odd and even frames show two different images")]


def shuffled(source: Source) -> list[Decision]:
    """Return a decision with the median jump between two frames, as a share of their width, if the image jumps back and forth.

    Only frames that are bright enough one by one show that.
    """
    steps = []
    for span in _spans(source, _FRAMES // 2):
        images = _frames(source, span)
        if images.mean() * source.info.height * source.info.width < _FEWEST_PHOTONS:
            continue
        spectra, shape = spectra_of(images), images.shape[1:]
        single, double = shifts_between(spectra, spectra[1:], shape), shifts_between(spectra, spectra[2:], shape)
        steps += [each for each in zip(single, single[1:], double, strict=False) if not any(shift is None for shift in each)]
    first, second, both = np.moveaxis(np.array(steps, np.float64).reshape(-1, 3, 2), 1, 0)
    agree = np.linalg.norm(first + second - both, axis=-1) < _TOLERANCE_PX
    if not np.count_nonzero(agree) > _FEWEST * len(agree):
        return []
    sizes, next_sizes = (np.linalg.norm(each[agree], axis=-1) for each in (first, second))
    jump = float(np.median(sizes)) * binning_of(source) / source.info.width
    if jump < _FAR or (first * second)[agree].sum() > _BACK * (sizes * next_sizes).sum():
        return []
    return [Decision(SHUFFLED, round(jump, 3), "of the width of a frame: so far the image jumps back and forth between frames")]


def _spans(source: Source, most: int) -> list[FrameSpan]:
    return source.info.spread(_PLACES, min(most, max(_SHORTEST, source.info.n_frames // _PLACES - 1)))


def _frames(source: Source, span: FrameSpan) -> FluxImage:
    """Return the binned frames of a span: (n, h, w)."""
    frames = [binned_mean(source, FrameSpan(frame, frame + 1)) for frame in range(span.start, span.stop)]
    return np.nan_to_num(np.array(frames, np.float32))


def _similarity(phases: FluxImage, reach: int) -> float | None:
    """Return how alike odd and even ones of four images (4, h, w) are, up to a shift by `reach` px; None if noise hides it.

    It is 1 for one image, whatever its brightness, since the noise of no two images is the same.
    """
    height, width = shape = phases.shape[1:]
    spectra = spectra_of(phases)
    y, x = fft.fftfreq(height)[:, np.newaxis], fft.rfftfreq(width)
    band = np.exp(-((2 * np.pi) ** 2) * (y**2 + x**2)) * (np.hypot(y * height, x * width) > 1 / _LONGEST_WAVE)
    near = np.ix_(np.arange(-reach, reach + 1) % height, np.arange(-reach, reach + 1) % width)

    def peak(cross: Spectrum) -> tuple[float, bool]:
        surface = fft.irfft2(band * cross, shape)
        highest = float(surface[near].max())
        surface[near] = 0
        return highest, highest > _SURE * surface.std()

    even, even_is_sure = peak(spectra[0].conj() * spectra[2])
    odd, odd_is_sure = peak(spectra[1].conj() * spectra[3])
    if not (even_is_sure and odd_is_sure):
        return None
    mixed, _ = peak((spectra[0] + spectra[2]).conj() * (spectra[1] + spectra[3]) / 4)
    return mixed / float(np.sqrt(even * odd))
