"""Look at a few frames all over a capture: whether they are neither dark nor saturated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from photonpano.errors import InputError
from photonpano.values import FrameSpan

if TYPE_CHECKING:
    from photonpano.protocols import Source
    from photonpano.values import StreamInfo

_PLACES, _FRAMES = 16, 16
"""At so many places, so many frames are looked at."""


def require_photons(source: Source) -> None:
    """Look at a few frames all over the capture, and refuse one that is all dark or all lit.

    Raises:
        InputError: no pixel, or every pixel, is lit in all of them; of grey levels, all are black, or saturated.
    """
    valid, spans = source.valid, _spread(source.info)
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
    spans = _spread(source.info)
    full = np.logical_and.reduce([source.counts(span) >= highest * len(span) for span in spans])
    return float(full[source.valid].mean())


def _spread(info: StreamInfo) -> list[FrameSpan]:
    """Return some spans all over a capture; all of it where it is short."""
    if info.n_frames <= _PLACES * _FRAMES:
        return [info.span]
    starts = np.linspace(0, info.n_frames - _FRAMES, _PLACES).astype(int).tolist()
    return [FrameSpan(start, start + _FRAMES) for start in starts]
