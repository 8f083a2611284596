"""Look at a few frames all over a capture: whether they are neither dark nor saturated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.errors import InputError

if TYPE_CHECKING:
    from photonpano.protocols import Source

_PLACES, _FRAMES = 16, 16
"""At so many places, so many frames are looked at."""


def require_photons(source: Source) -> None:
    """Look at a few frames all over the capture, and refuse one that is all dark or all lit.

    Raises:
        InputError: no pixel, or every pixel, is lit in all of them; of grey levels, all are black, or saturated.
    """
    valid, spans = source.valid, source.info.spread(_PLACES, _FRAMES)
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
    spans = source.info.spread(_PLACES, _FRAMES)
    full = np.logical_and.reduce([source.counts(span) >= highest * len(span) for span in spans])
    return float(full[source.valid].mean())
