"""Track short sums of frames by phase correlation, from frames alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, islice

import numpy as np

from photonpano.context import Context
from photonpano.motion.tracking.spans import shifts_between, span_image, spectra_of
from photonpano.protocols import Source
from photonpano.values import FloatArray, FrameSpan

_MIN_SUMS = 6  # of a track
DARK = 0.2  # sums, and frames, with less than this share of the usual light show nothing
_BLOCK = 32  # sums that are tracked in one task


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
