"""Find the first and the last frame that saw each pixel of a canvas, from the motion alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.compiling import compiled
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import Canvas
from photonpano.merging.accumulate import chunks_of
from photonpano.merging.warping import Grid, Lens, footprints_of, image_row
from photonpano.values import FrameSpan

NEVER = np.iinfo(np.uint32).max  # in place of a frame where none saw the pixel
_TOLERANCE_PX = 1.0  # motion of frames whose borders are taken for one


def seen_frames(source: Source, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> NDArray[np.uint32]:
    """Return the first and the last frame of a span that saw each pixel of a canvas: (2, H, W), `NEVER` where none did.

    What a mask or something before the background leaves out was not seen, and neither was what frames without light show.
    """
    capture, (height, width) = capture_of(source), canvas.shape
    chunks = chunks_of(span, trajectory, capture.info.frame_shape, _TOLERANCE_PX, [each.start for each in capture.pieces(span)])
    homographies = np.array([chunk.homography for chunk in chunks])
    places, grid = footprints_of(canvas, capture.camera, homographies, capture.info.frame_shape), Grid.zeros(canvas, 0)
    found = np.full((2, height, width), NEVER, np.uint32)
    for chunk, at in zip(chunks, places, strict=True):
        frames = np.arange(chunk.span.start, chunk.span.stop, dtype=np.uint32)
        if capture.light is not None:
            frames = frames[capture.light.shown[frames]]
        if not len(frames):
            continue
        shown = capture.shown_pixels(chunk.span)
        pixels = capture.valid.view(np.uint8) if shown is None else capture.valid & shown
        for part in grid.parts(at):
            _mark(pixels, np.ascontiguousarray(at.to_image), at.lens, at.shrink, frames[[0, -1]], part, found)
    return found


@compiled
def _mark(  # noqa: PLR0917
    pixels: NDArray[np.uint8],
    matrix: NDArray[np.float64],
    lens: Lens,
    shrink: int,
    frames: NDArray[np.uint32],
    grid: Grid,
    found: NDArray[np.uint32],
) -> None:
    """Enter the first and the last of some frames, later than those before, where pixels of the grid show one of theirs."""
    height, width = pixels.shape
    u, v = np.empty(len(grid.p), np.float32), np.empty(len(grid.p), np.float32)
    half, side, right, bottom = np.float32(0.5), np.float32(shrink), np.float32(width), np.float32(height)
    early, late = frames
    whole = pixels.all()
    for y in range(len(grid.q)):
        image_row(matrix, lens, grid, y, u, v)
        columns = slice(grid.left, grid.left + len(u))
        first, last = found[0, grid.top + y, columns], found[1, grid.top + y, columns]
        for t in range(0 if whole else len(u)):
            across, down = np.int32((u[t] + half) * side), np.int32((v[t] + half) * side)
            if 0 <= across < width and 0 <= down < height and not pixels[down, across]:
                u[t] = np.float32(-9)  # outside of the frame
        for t in range(len(u)):
            across, down = (u[t] + half) * side, (v[t] + half) * side
            inside = across >= 0 and across < right and down >= 0 and down < bottom
            first[t] = min(first[t], early) if inside else first[t]
            last[t] = late if inside else last[t]
