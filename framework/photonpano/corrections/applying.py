"""Apply a list of corrections to a capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from photonpano.capture import MISSING, Capture, Gather, Index, LinearCorrection, MaskedSpan, capture_of, numbered
from photonpano.contracts.protocols import Source
from photonpano.corrections.colour_filter import ColourFilter, with_colours
from photonpano.corrections.dark import DarkCounts
from photonpano.corrections.geometry import Correction, Decide, Pixels
from photonpano.errors import InputError
from photonpano.values import BoolArray, Decision, FluxImage

_TOUCHING = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0))
_CORNER_WEIGHT = 0.5  # of a neighbour that touches a pixel at a corner, relative to one that shares an edge


def corrected_source(
    source: Source,
    corrections: Sequence[Correction],
    blame: Callable[[int, str], Exception] | None = None,
    look: bool = True,
) -> Capture:
    """Return a capture with corrections, in order. Frames and counts stay whole numbers, as they were recorded.

    Args:
        source: the capture as it is read; closing the corrected one closes it.
        corrections: in the order in which they are applied.
        blame: makes the error to raise, from the place of a correction in the list and a sentence.
        look: whether corrections may read frames. If not, what depends on frames is left out.

    Raises:
        InputError: a correction does not suit the capture, a file holds something else, or no pixel is left.
    """
    capture, decisions = capture_of(source), list[Decision]()
    pixels = _applied(capture, corrections, None, blame)
    if look:
        pixels = _applied(capture, corrections, lambda *chosen: decisions.append(Decision(*chosen)), blame)
    valid = pixels.valid.copy()
    corrected = _rearranged(capture, pixels.index)
    if any(correction.changes_sums for correction in corrections):
        step = _linear(pixels, valid, capture.info.kind == "binary")
        corrected = replace(corrected, steps=(step,))
    valid.flags.writeable = False
    corrected = replace(corrected, valid=valid, masks=_masks(pixels), still=pixels.still, decisions=tuple(decisions))
    if capture.colour is not None:
        parts = {
            name: replace(_rearranged(part, pixels.index), valid=valid, steps=corrected.steps)
            for name, part in capture.colour.parts.items()
        }
        corrected = replace(corrected, colour=replace(capture.colour, parts=parts))
    if any(isinstance(correction, ColourFilter) and correction.in_colour for correction in corrections):
        return with_colours(corrected, pixels.colour, look)
    return corrected


def _applied(
    capture: Capture,
    corrections: Sequence[Correction],
    decide: Decide | None,
    blame: Callable[[int, str], Exception] | None,
) -> Pixels:
    """Apply corrections to the pixels of a capture, one after the other; for `decide`, see `Correction.applied`."""
    pixels = Pixels.as_read(capture)
    for place, correction in enumerate(corrections):
        try:
            if capture.corrects_sums:
                raise InputError("this source corrects its sums itself, and cannot be corrected further")
            if capture.colour is not None and isinstance(correction, ColourFilter | DarkCounts):
                raise InputError(f"{correction.name} is for one channel, and this capture has three; leave it out")
            pixels = correction.applied(pixels, capture, decide)
            pixels.require_some(correction.name)
        except InputError as error:
            if blame is None:
                raise
            raise blame(place, str(error)) from error
    return pixels


def _rearranged(capture: Capture, index: Index) -> Capture:
    """Return a capture whose pixels are those of an index. Where pixels are moved, neither camera nor colours are known."""
    info = replace(capture.info, height=index.shape[0], width=index.shape[1], bayer=None)
    if np.array_equal(index, numbered(capture.info.frame_shape)):
        return replace(capture, info=info, colour=None)
    gather = Gather(index, capture.info.frame_shape)
    weight = None if capture.weight is None else gather(capture.weight)
    if capture.gather is not None:
        before = capture.gather.index.ravel()[index]
        gather = Gather(np.where(index == MISSING, MISSING, before), capture.source.info.frame_shape)
    return replace(capture, info=info, gather=gather, weight=weight, camera=None, colour=None)


def _masks(pixels: Pixels) -> tuple[MaskedSpan, ...]:
    """Return the masks of some frames; a pixel that is interpolated from a masked one is masked, too."""
    if not pixels.masks or not pixels.interpolated.any():
        return pixels.masks
    from scipy.ndimage import minimum_filter

    usable = (np.where(pixels.interpolated, minimum_filter(each.valid, 3), each.valid) for each in pixels.masks)
    return tuple(replace(each, valid=valid) for each, valid in zip(pixels.masks, usable, strict=True))


def _linear(pixels: Pixels, valid: BoolArray, binary: bool) -> LinearCorrection:
    """Return the correction for dark counts and interpolated pixels; mask those without a usable neighbour in `valid`.

    With flux f and dark counts d per frame, a pixel stays dark in `n exp(-f - d)` of n binary frames on average. So k counts
    become `n - (n - k) exp(d)`, which is on average the count without dark counts.
    """
    rates = pixels.dark_rates
    slope, offset = (np.exp(rates), -np.expm1(rates)) if binary else (np.ones_like(rates), -rates)
    filled, neighbours, shares = _filling(pixels)
    lonely = shares.sum(axis=1) == 0
    valid.ravel()[filled[lonely]] = False
    filled, neighbours, shares = filled[~lonely], neighbours[~lonely], shares[~lonely]
    if not filled.size:
        return LinearCorrection(slope, offset)
    return LinearCorrection(slope, offset, (filled, neighbours, shares / shares.sum(axis=1, keepdims=True)))


def _filling(pixels: Pixels) -> tuple[Index, Index, FluxImage]:
    """Return the pixels to interpolate, their neighbours, and the weights of these: 0 for one that must not be used."""
    height, width = pixels.shape
    usable = np.pad(pixels.valid & ~pixels.interpolated, 1)
    rows, columns = np.nonzero(pixels.interpolated & pixels.valid)
    filled = (rows * width + columns).astype(np.intp)
    neighbours = np.empty((len(filled), len(_TOUCHING)), np.intp)
    weights = np.empty(neighbours.shape, np.float32)
    for place, (down, right) in enumerate(_TOUCHING):
        y, x = np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)
        neighbours[:, place] = y * width + x
        weights[:, place] = usable[rows + down + 1, columns + right + 1] * (_CORNER_WEIGHT if down and right else 1)
    return filled, neighbours, weights
