"""Look at some frames all over a capture: whether they show anything, and which pixels are not to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano.errors import InputError
from photonpano.values import FrameSpan

if TYPE_CHECKING:
    from collections.abc import Sequence

    from photonpano.protocols import Source
    from photonpano.values import BoolArray, StreamInfo

_PLACES = 16
_FEW_FRAMES, _MORE_FRAMES = 16, 32
"""Frames that are looked at at each place: to see whether there is light, and to judge pixels."""
_NEIGHBOURS_PX = 5
"""A pixel is compared with the median of a square of so many."""
_OUTSTANDING, _BRIGHTER = 6.0, 2.0
"""A hot pixel exceeds that median by so many standard deviations, and has so many times its flux."""


@dataclass(frozen=True, slots=True)
class PixelSummary:
    """How many of the pixels that may be used give reason for doubt.

    Attributes:
        n_frames: how many frames tell it.
        unused_share: pixels of the frame that the capture itself says are not to be used.
        hot_share: pixels that are brighter than their neighbours whatever the camera sees.
        saturated_share: other pixels that are at their highest value in every frame, so that their flux is unknown.
    """

    n_frames: int
    unused_share: float
    hot_share: float
    saturated_share: float


def require_photons(source: Source) -> None:
    """Look at a few frames all over the capture, and refuse one that is all dark or all lit.

    Raises:
        InputError: no pixel, or every pixel, is lit in all of them.
    """
    valid, spans = source.valid, _spread(source.info, _FEW_FRAMES)
    lit = sum(int(source.counts(span)[valid].sum()) for span in spans)
    seen = sum(map(len, spans))
    if lit == 0:
        raise InputError(
            f"no pixel is lit in any of {seen} frames looked at all over the capture; "
            "check that the file is the right one, and that the lens was open"
        )
    if source.info.kind == "binary" and lit == seen * int(valid.sum()):
        raise InputError(
            f"every pixel is lit in all of {seen} frames looked at all over the capture, so that no flux can be told; "
            "check the layout of the file, or expose less"
        )


def judge_pixels(source: Source) -> PixelSummary:
    """Estimate from some hundreds of frames all over the capture how many pixels are hot or saturated.

    A pixel is taken to be hot if it stands out from its neighbours in both halves of the capture. So nothing is that moves
    through the image; what is bright and small, and keeps its place since the camera does, cannot be told from it.
    """
    spans = _spread(source.info, _MORE_FRAMES)
    # The only span of a short capture is both of its halves.
    halves = spans[: max(1, len(spans) // 2)], spans[len(spans) // 2 :]
    valid = source.valid
    hot = valid & np.logical_and.reduce([_outstanding(source, half) for half in halves])
    highest = 2**source.info.bit_depth - 1
    full = np.logical_and.reduce([source.counts(span) == highest * len(span) for span in spans])
    usable = int(valid.sum())
    return PixelSummary(
        sum(map(len, spans)),
        1 - usable / valid.size,
        int(hot.sum()) / usable,
        int((full & valid & ~hot).sum()) / usable,
    )


def _outstanding(source: Source, spans: Sequence[FrameSpan]) -> BoolArray:
    """Return which pixels are far brighter than the pixels around them: (H, W)."""
    n_frames = float(sum(map(len, spans)))
    counts = np.sum([source.counts(span) for span in spans], axis=0)
    flux = source.response.flux(np.asarray(counts / n_frames, dtype=np.float32), n_frames)
    level = source.response.stabilised(flux, n_frames)
    excess = level - cv2.medianBlur(level, _NEIGHBOURS_PX)
    # Texture, too, sets pixels apart from their neighbours; 1.4826 turns a median deviation into a standard one.
    noise = max(1.4826 * float(np.median(np.abs(excess))), float(source.response.stabilised_std(n_frames)))
    return np.asarray((excess > _OUTSTANDING * noise) & (flux > _BRIGHTER * cv2.medianBlur(flux, _NEIGHBOURS_PX)))


def _spread(info: StreamInfo, n_frames: int) -> list[FrameSpan]:
    """Return spans of so many frames all over a capture; all of it where it is short."""
    if info.n_frames <= _PLACES * n_frames:
        return [info.span]
    starts = np.linspace(0, info.n_frames - n_frames, _PLACES).astype(int).tolist()
    return [FrameSpan(start, start + n_frames) for start in starts]
