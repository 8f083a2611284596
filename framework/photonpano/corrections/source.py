"""Apply corrections to a source."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photonpano.corrections.colour_filter import ColourFilter
from photonpano.corrections.colours import FilteredSource, filtered
from photonpano.corrections.geometry import Rearrangement
from photonpano.corrections.pixels import MISSING, Correction, Decide, Index, Pixels, numbered
from photonpano.errors import InputError
from photonpano.protocols import KnowsSharpViews, KnowsTruth, LinearlyCorrectedSource, PackedSource, Source
from photonpano.source_wrapper import ArrayT, SharpViewsWrapper, SourceWrapper, TruthWrapper, with_capabilities
from photonpano.threads import Guard
from photonpano.values import BoolArray, Counts, Decision, FluxImage, FrameSpan, StreamInfo

_TOUCHING = tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0))
_CORNER_WEIGHT = 0.5
"""Weight of a neighbour that touches a pixel with a corner only, relative to one that shares an edge."""


def apply_corrections(
    source: Source,
    corrections: Sequence[Correction],
    decide: Decide | None = None,
    blame: Callable[[int, str], Exception] | None = None,
) -> Pixels:
    """Apply corrections to the pixels of a capture, one after the other.

    Args:
        source: the capture as it is read.
        corrections: in the order in which they are applied.
        decide: see `Correction.applied`.
        blame: makes the error to raise, from the place of the correction in the list and a sentence.

    Raises:
        InputError: a correction does not suit the capture, a file holds something else, or no pixel is left.
    """
    pixels = Pixels.as_read(source.valid)
    for place, correction in enumerate(corrections):
        try:
            if isinstance(source, LinearlyCorrectedSource):
                raise InputError("this source corrects its sums itself, and cannot be corrected further")
            pixels = correction.applied(pixels, source, decide)
            if not pixels.valid.any():
                raise InputError(f"{correction.name} leaves no pixel that may be used")
        except InputError as error:
            if blame is None:
                raise
            raise blame(place, str(error)) from error
    return pixels


def corrected_source(
    source: Source, corrections: Sequence[Correction], blame: Callable[[int, str], Exception] | None = None
) -> CorrectedSource | FilteredSource:
    """Return a source with corrections.

    It has `packed` if the source has, `truth` and `sharp_view` if the source has and no pixel is moved, and `corrected` if a
    correction changes sums of frames. It is a `ColouredSource` if a correction keeps all colours.

    Args:
        source: the capture as it is read; closing the corrected source closes it.
        corrections: in the order in which they are applied.
        blame: see `apply_corrections`.

    Raises:
        InputError: see `apply_corrections`. What depends on frames is checked when `valid` is first read.
    """
    capabilities: list[type[SourceWrapper]] = [_PackedFrames] if isinstance(source, PackedSource) else []
    if isinstance(source, KnowsTruth) and not any(isinstance(correction, Rearrangement) for correction in corrections):
        capabilities.append(TruthWrapper)
        if isinstance(source, KnowsSharpViews):
            capabilities.append(SharpViewsWrapper)
    if any(correction.changes_sums for correction in corrections):
        capabilities.append(_CorrectedSums)
    corrected = with_capabilities(CorrectedSource, capabilities)(source, corrections, blame)
    in_colour = any(isinstance(correction, ColourFilter) and correction.in_colour for correction in corrections)
    if not in_colour:
        return corrected
    return filtered(corrected, lambda: corrected.estimate().colour, corrected.decisions)


class CorrectedSource(SourceWrapper):
    """A source whose frames are rearranged and whose bad pixels are masked: made by `corrected_source`.

    Frames and counts stay whole numbers, as they were recorded.

    Attributes:
        decisions: what was chosen because of what the capture shows; complete once `valid` has been read.
    """

    def __init__(
        self, source: Source, corrections: Sequence[Correction], blame: Callable[[int, str], Exception] | None = None
    ) -> None:
        super().__init__(source)
        self._corrections, self._blame = tuple(corrections), blame
        index = apply_corrections(source, corrections, blame=blame).index
        self.gather = _Gather(index, source.info.frame_shape)
        self._estimate: _Estimate | None = None
        self._lock = Guard()
        self.decisions: list[Decision] = []
        self._info = replace(source.info, height=index.shape[0], width=index.shape[1], bayer=None)

    @property
    def info(self) -> StreamInfo:
        """Frames, size, rate."""
        return self._info

    @property
    def valid(self) -> BoolArray:
        """(H, W) mask."""
        return self.estimate().valid

    def read(self, method: Callable[[FrameSpan], ArrayT], span: FrameSpan, shape: tuple[int, ...]) -> ArrayT:
        """See `SourceWrapper`."""
        del shape
        gathered: ArrayT = self.gather(method(span))
        return gathered

    def estimate(self) -> _Estimate:
        """Return what is estimated of the pixels; the first call reads frames if a correction needs them."""
        with self._lock:
            if self._estimate is None:
                pixels = apply_corrections(self.wrapped, self._corrections, self._decide, self._blame)
                self._estimate = _Estimate.of(pixels, self.info.kind == "binary")
            return self._estimate

    def __getstate__(self) -> dict[str, Any]:
        """Travel with what is estimated of the pixels, so that no frames are read for it again."""
        self.estimate()
        return {**self.__dict__, "_corrections": (), "_blame": None}

    def _decide(self, what: str, value: float, reason: str) -> None:
        self.decisions.append(Decision(what, value, reason))


class _PackedFrames(CorrectedSource):
    """What a corrected source offers if the capture is packed."""

    wrapped: PackedSource

    def packed(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span, eight pixels to a byte: see `PackedSource`."""
        return self.wrapped.packed(span) if self.gather.identity else np.packbits(self.frames(span), axis=-1)


class _CorrectedSums(CorrectedSource):
    """What a corrected source offers if a correction changes sums of frames."""

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Take everything but the flux out of a sum of frames: see `LinearlyCorrectedSource`."""
        return self.estimate().corrected(counts, n_frames)


class _Gather:
    """Gathers the pixels of an index from frames; as a slice if the index is a contiguous part of the frame."""

    def __init__(self, index: Index, frame_shape: tuple[int, int]) -> None:
        self._missing = index == MISSING
        self._index = np.where(self._missing, 0, index)
        self._slices = _slices(index, frame_shape)
        self.identity = bool(np.array_equal(index, numbered(frame_shape)))

    def __call__(self, frames: Any) -> Any:
        """Gather the pixels of (..., h, w) frames: (..., H, W), 0 where the sensor has none."""
        if self._slices is not None:
            return np.ascontiguousarray(frames[..., self._slices[0], self._slices[1]])
        *n, _, _ = frames.shape
        gathered = np.take(frames.reshape(*n, -1), self._index, axis=-1)
        gathered[..., self._missing] = 0
        return gathered


def _slices(index: Index, frame_shape: tuple[int, int]) -> tuple[slice, slice] | None:
    """Return the rows and columns of an index that is a contiguous part of the frame; None for others."""
    top, left = divmod(int(index[0, 0]), frame_shape[1])
    part = slice(top, top + index.shape[0]), slice(left, left + index.shape[1])
    return part if np.array_equal(numbered(frame_shape)[part], index) else None


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Corrects sums of frames for dark counts and missing pixels.

    With flux f and dark counts d per frame, a pixel stays dark in `n exp(-f - d)` of n binary frames on average. So k counts
    become `n - (n - k) exp(d)`, which is on average the count without dark counts.

    Attributes:
        valid: (H, W) bool, pixels that may be used.
        gain: (H, W) float32, factor of the counts; 1 where there is nothing to correct.
        offset: (H, W) float32, subtracted for each frame.
        filled: (P,) numbers of the pixels that are replaced by their neighbours.
        neighbours: (P, 8) numbers of the neighbours of each.
        weights: (P, 8) float32, weights of the neighbours; each row sums to 1.
        colour: (H, W) int8, see `Pixels`.
    """

    valid: BoolArray
    gain: FluxImage
    offset: FluxImage
    filled: Index
    neighbours: Index
    weights: FluxImage
    colour: NDArray[np.int8]

    @classmethod
    def of(cls, pixels: Pixels, binary: bool) -> _Estimate:
        """Compute the correction once for all sums."""
        rates = pixels.dark_rates
        gain, offset = (np.exp(rates), np.expm1(rates)) if binary else (np.ones_like(rates), rates)
        filled, neighbours, weights = _filling(pixels)
        # A pixel without a usable neighbour is masked: the motion fills it.
        lonely = weights.sum(axis=1) == 0
        valid = pixels.valid.copy()
        valid.ravel()[filled[lonely]] = False
        valid.flags.writeable = False
        filled, neighbours, weights = filled[~lonely], neighbours[~lonely], weights[~lonely]
        weights = weights / weights.sum(axis=1, keepdims=True)
        return cls(valid, gain, offset, filled, neighbours, weights, pixels.colour)

    def corrected(self, counts: Counts, n_frames: int) -> FluxImage:
        """Correct a sum of frames: see `LinearlyCorrectedSource`."""
        summed = counts * self.gain - np.float32(n_frames) * self.offset
        summed = summed.astype(np.float32, copy=False)
        flat = summed.reshape(-1)
        flat[self.filled] = (flat[self.neighbours] * self.weights).sum(axis=1)
        return summed


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
