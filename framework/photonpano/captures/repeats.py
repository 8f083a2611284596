"""Find frames that are copies of the frame before."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.context import Context
from photonpano.errors import InputError
from photonpano.motion.timeline import Timeline
from photonpano.protocols import Source
from photonpano.values import BoolArray, FrameSpan, true_spans

_BLOCK_FRAMES = 256  # frames that are compared at a time
_ROW_STRIDE = 16  # frames are compared on every 16th row first
# Frames that are repeated differ from the frame before by this many newly lit pixels, and as many that went dark: dark frames
# are alike by chance, and so are saturated ones.
_FEWEST_NEW = 20


def timeline_of(source: Source, context: Context) -> Timeline:
    """Return the timeline of a capture, in which repeated frames take no time; raise an `InputError` if all are copies.

    Only packed frames are compared: others would have to be read twice.
    """
    capture, n_frames = capture_of(source), source.info.n_frames
    if not capture.is_packed:
        return Timeline.regular(n_frames)
    spans = [FrameSpan(max(0, span.start - 1), span.stop) for span in source.info.span.blocks(_BLOCK_FRAMES)]
    same = np.zeros(n_frames, dtype=bool)
    for span, found in zip(spans, context.in_order(partial(_same_as_before, capture), spans), strict=True):
        same[span.start + 1 : span.stop] = found
    if n_frames > 1 and same[1:].all():
        raise InputError(f"all {n_frames} frames are copies of the first one; check that the camera went on recording")
    for run in true_spans(same):
        original = run.start - 1
        if original and not _differ(*capture.packed(FrameSpan(original - 1, original + 1))):
            same[run.start : run.stop] = False
    return Timeline.with_repeats(same)


def _same_as_before(capture: Capture, span: FrameSpan) -> BoolArray:
    """Return whether each frame of a span but the first equals the one before it."""
    packed = capture.packed(span)
    some = packed[:, ::_ROW_STRIDE]
    same = (some[1:] == some[:-1]).all(axis=(1, 2))
    for index in np.flatnonzero(same):
        same[index] = np.array_equal(packed[index], packed[index + 1])
    return np.asarray(same)


def _differ(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> bool:
    """Return whether photons make two packed frames differ, so that others that are equal are copies."""
    return all(int(np.unpackbits(new).sum()) >= _FEWEST_NEW for new in (first & ~second, second & ~first))
