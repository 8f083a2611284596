"""The panorama: every frame whose motion is known, warped onto one canvas and estimated once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.geometry import canvas_of
from photonpano.merging import accumulate, chunks_of
from photonpano.values import Panorama

if TYPE_CHECKING:
    from photonpano.geometry import Canvas
    from photonpano.pipeline.progress import Progress
    from photonpano.protocols import Source, Trajectory
    from photonpano.values import FrameSpan

BYTES_PER_PIXEL = 40
"""Peak memory for each pixel of the canvas: sums, estimate and what is written, as measured in the tests."""


def plan_canvas(trajectory: Trajectory, span: FrameSpan, frame_shape: tuple[int, int], scale: float, memory: int) -> Canvas:
    """Choose the canvas that holds every frame of a span, before anything of its size is allocated.

    Args:
        trajectory: the motion, frame pixels to reference pixels.
        span: the frames that are to be seen.
        frame_shape: (height, width) of a frame.
        scale: pixels of the canvas per pixel of the reference frame.
        memory: bytes that a panorama may take.

    Raises:
        CanvasTooLargeError: it would take more; the message says how much.
        LocationError: frames reach the horizon of the reference plane.
    """
    homographies = trajectory.at(np.arange(span.start, span.stop))
    try:
        canvas = canvas_of(homographies, frame_shape, scale)
    except ValueError as error:
        raise LocationError(
            f"the motion turns so far away from the reference frame that a flat panorama cannot show it ({error}); "
            "choose a render.reference in the middle of the motion, or fewer frames"
        ) from error
    needed = canvas.height * canvas.width * BYTES_PER_PIXEL
    if needed > memory:
        fitting = scale * np.sqrt(memory / needed)
        raise CanvasTooLargeError(
            f"the panorama would have {canvas.width} x {canvas.height} pixels and take {_gib(needed)}, more than the "
            f"{_gib(memory)} of run.memory. Raise run.memory, lower render.scale from {scale:g} to {_rounded_down(fitting):g}, "
            "or choose a render.reference nearer to the middle of the motion"
        )
    return canvas


def render(
    source: Source,
    trajectory: Trajectory,
    span: FrameSpan,
    canvas: Canvas,
    tolerance_px: float,
    threads: int,
    progress: Progress,
) -> Panorama:
    """Merge the frames of a span on a canvas: warped, summed, and one maximum-likelihood estimate for each pixel.

    Args:
        source: the capture.
        trajectory: frame pixels to reference pixels.
        span: the frames that are merged.
        canvas: the pixel grid.
        tolerance_px: frames that move less than this are summed before they are warped.
        threads: how many work on it; the result does not depend on it.
        progress: is told of the frames.
    """
    with progress.stage("panorama", len(span), "frames") as advance:
        chunks = chunks_of(span, trajectory, source.info.frame_shape, tolerance_px)
        with ThreadPoolExecutor(threads, thread_name_prefix="render") as pool:
            photons = accumulate(source, chunks, canvas.transform, canvas.shape, advance, pool, threads)
    flux, weight = photons.estimate(source.response)
    return Panorama(flux, weight, canvas.transform)


def _gib(size: float) -> str:
    return f"{size / 1024**3:.2g} GiB"


def _rounded_down(scale: float) -> float:
    """Round down to two digits, so that the suggested scale fits."""
    digit = 10.0 ** (np.floor(np.log10(scale)) - 1)
    return float(np.floor(scale / digit) * digit)
