"""Make the pictures of a video: frames merged along the motion, in the plane of the panorama or along a smooth path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source, camera_of
from photonpano.execution.context import Context
from photonpano.execution.threads import in_order
from photonpano.geometry import Camera, Canvas, outline_of
from photonpano.merging.colour import composed
from photonpano.merging.panorama import render
from photonpano.motion.frame_motion import FrameMotion, smooth_view
from photonpano.photometry import WhiteBalance, balanced, grey_world, linear_to_srgb
from photonpano.record.picture_files import Picture
from photonpano.values import FloatArray, FluxImage, FrameSpan

# The white balance "grey-world" is averaged over this many pictures of the video, so that it does not flicker.
_BALANCED_ON = 16
_DIMMED = 0.4  # brightness of the panorama outside the frame, relative to a still
_LINES_PER_PX = 1 / 300  # width of the outline, as a fraction of the longer side
_THINNEST_PX, _MARGIN_PX = 2, 4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Film:
    """What the pictures of a video show."""

    source: Source  # the capture, divided by its vignette and in its light
    motion: FrameMotion
    canvas: Canvas  # of the panorama; of the view of a frame, if the path is smooth
    tolerance_px: float  # motion within which frames are summed before they are warped
    # standard deviation of the smooth path, in frames; None for pictures in the plane of the panorama
    smooth_frames: float | None
    white_flux: float  # flux that is white, photons per pixel per frame
    white_balance: WhiteBalance
    # (H, W) or (H, W, 3) flux, shown around the frame, whose outline is drawn; None for neither
    panorama: FluxImage | None = None

    def pictures(self, spans: Sequence[FrameSpan], threads: int, bits: Literal[8, 16]) -> Iterator[Picture]:
        """Yield the picture of each exposure, in order: (H, W) or (H, W, 3), red first, in sRGB; unknown pixels are black.

        The pictures do not depend on the number of `threads`; `bits` are those of a value.
        """
        film = self._balanced(spans) if capture_of(self.source).colour is not None else self
        around = None if self.panorama is None else np.nan_to_num(_DIMMED * film._levels(self.panorama))

        def picture(span: FrameSpan) -> Picture:
            levels = film._picture(span, around)
            if bits == 8:
                return np.asarray(levels * 255 + 0.5).astype(np.uint8)
            return np.asarray(levels * 65535 + 0.5).astype(np.uint16)

        return in_order(picture, spans, threads)

    def exposure(self, span: FrameSpan) -> FluxImage:
        """Return the flux of some frames, merged along the motion: (H, W) or (H, W, 3), NaN where it is unknown."""
        canvas = self.canvas
        if self.smooth_frames is not None:
            to_view = np.linalg.inv(smooth_view(self.motion, span.centre, self.smooth_frames))
            canvas = replace(canvas, transform=canvas.transform @ to_view)
        return merged(self.source, self.motion, span, canvas=canvas, tolerance_px=self.tolerance_px, threads=1)

    def _picture(self, span: FrameSpan, around: FluxImage | None) -> FluxImage:
        """Return levels from 0 to 1, with those of the panorama around the frame."""
        picture = self._levels(self.exposure(span))
        if around is None:
            return np.nan_to_num(picture)
        outline = outline_on(self.canvas, self.motion, self.motion.camera or camera_of(self.source), span.centre)
        outline = outline if picture.ndim == 2 else outline[..., None]
        return np.asarray(np.maximum(np.where(np.isnan(picture), around, picture), outline), np.float32)

    def _levels(self, flux: FluxImage) -> FluxImage:
        return linear_to_srgb(balanced(flux, self.white_balance) / self.white_flux)

    def _balanced(self, spans: Sequence[FrameSpan]) -> Film:
        """Return the same with one white balance for all pictures."""
        if self.white_balance != "grey-world":
            return self
        chosen = sorted({round(place) for place in np.linspace(0, len(spans) - 1, _BALANCED_ON)})
        pictures = [self.exposure(spans[place]) for place in chosen]
        red, green, blue = np.mean([grey_world(each) for each in pictures if np.isfinite(each).any()], axis=0).tolist()
        return replace(self, white_balance=(red, green, blue))


def merged(
    source: Source, motion: FrameMotion, span: FrameSpan, *, canvas: Canvas, tolerance_px: float, threads: int
) -> FluxImage:
    """Merge frames on a canvas along a motion; of a filter array, the colours: (H, W) or (H, W, 3)."""
    return composed(render(source, motion.trajectory, span, canvas, tolerance_px, Context(threads=threads)), source).flux


def outline_on(canvas: Canvas, motion: FrameMotion, camera: Camera | None, instant: float) -> FluxImage:
    """Draw the outline of a frame, through the lens of its camera, on a canvas: (H, W) from 0 to 1."""
    points = outline_of(motion.frame_shape)
    if camera is not None:
        points = camera.ideal(points)
    rays = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    rays = rays @ (canvas.plane_to_rays @ motion.trajectory.at([instant])[0]).T
    if canvas.planar:
        rays = rays[rays[:, 2] > 0]
    # OpenCV draws no smooth lines on the outermost pixels.
    image = np.zeros((canvas.height + 2 * _MARGIN_PX, canvas.width + 2 * _MARGIN_PX), np.uint8)
    width = max(_THINNEST_PX, round(max(canvas.shape) * _LINES_PER_PX))
    for line in _whole_lines(canvas.pixels(rays), canvas.period_px):
        cv2.polylines(image, [np.rint(16 * (line + _MARGIN_PX)).astype(np.int32)], False, 255, width, cv2.LINE_AA, shift=4)
    inside = slice(_MARGIN_PX, -_MARGIN_PX)
    return np.asarray(image[inside, inside] / 255, np.float32)


def _whole_lines(points: FloatArray, period_px: float | None) -> Iterator[FloatArray]:
    """Yield a closed line, once for each full turn at which it may be seen, without a jump from one end to the other."""
    closed = np.concatenate([points, points[:1]])
    if period_px is None:
        yield closed
        return
    unwrapped = np.unwrap(closed[:, 0], period=period_px)
    for turn in (-1, 0, 1):
        yield np.stack([unwrapped + turn * period_px, closed[:, 1]], axis=-1)
