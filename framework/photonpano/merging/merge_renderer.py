"""Merge all frames on a canvas: one maximum-likelihood estimate for each pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from photonpano.merging.accumulate import accumulate
from photonpano.merging.chunks import chunks_of
from photonpano.photometry import debiased
from photonpano.protocols import Source, Trajectory
from photonpano.threads import InOrder
from photonpano.values import FrameSpan, Panorama

if TYPE_CHECKING:
    from photonpano.geometry import Canvas


class MergeRenderer:
    """Warps the photons of all frames to the canvas, and estimates the flux of each pixel once (paper, equation 3)."""

    def __init__(self, in_order: InOrder) -> None:
        """Take what works on several parts at once, such as that of a `StageContext`; the result does not depend on it."""
        self._in_order = in_order

    def render(
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Merge the frames of a span on a canvas: see `Renderer`."""
        chunks = chunks_of(span, trajectory, source.info.frame_shape, tolerance_px)
        photons = accumulate(source, chunks, canvas, canvas.shape, advance, self._in_order)
        flux, weight = photons.estimate(source.response)
        return Panorama(debiased(flux, weight, source.response), weight, canvas.transform)
