"""Predict the photons of frames from the panorama and the motion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import Camera, Canvas, corners
from photonpano.merging.light import gain_image
from photonpano.photometry import frame_variance
from photonpano.residuals.block_sums import sample_places, sample_view
from photonpano.values import FloatArray, FluxImage, FrameSpan, Homography, Light, Panorama, Response

_BLUR_PX = 0.7  # standard deviation of the Gaussian that smooths the panorama: its noise must not pass for texture
_INTERPOLATION_PX2 = 1 / 6  # variance of the kernel of one linear interpolation, averaged over the fractions of a pixel
_MANY_FRAMES = 1e4  # of a mean count that is exact
_MARGIN = 4  # columns with which a full turn is continued on each side: more than the smoothing reaches
_STRAIGHT_RUN_PX = 64  # from this length of straight runs on, the compiled interpolation is faster than OpenCV's


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """The panorama, in one colour, as the camera would see it from any instant: a `PanoramaView`.

    The panorama is smoothed, and then sharpened by as much as smoothing and interpolation have blurred it, to second order. So
    its noise is low and its edges are where they were.
    """

    canvas: Canvas  # of the panorama
    # (H, W) float32, expected count of a frame; NaN where the panorama was not seen. Of a full turn, it has `margin` columns
    # more on each side, which continue on the other side.
    mean: FluxImage
    precision: FluxImage  # (H, W) float32, 1 / variance of the count of a frame; 0 where the panorama was not seen
    trajectory: Trajectory
    frame_shape: tuple[int, int]  # (height, width) of a frame
    frames_seen: float  # frames that saw a place of the panorama, the median over its pixels
    response: Response  # of the camera
    light: Light | None = None  # the gain of each frame; None in steady light
    # (H, W, 3) homogeneous ideal pixels of the pixels of a frame; None if homographies map them to the panorama
    ideal: FloatArray | None = None
    margin: int = 0  # see `mean`

    @classmethod
    def of(
        cls,
        panorama: Panorama,
        canvas: Canvas,
        response: Response,
        trajectory: Trajectory,
        frame_shape: tuple[int, int],
        light: Light | None = None,
        camera: Camera | None = None,
    ) -> Prediction:
        """Make the prediction of a panorama that was rendered along the trajectory, frame pixels to reference pixels."""
        margin = _MARGIN if canvas.is_full_turn else 0
        panorama = _continued(panorama, margin)
        seen = panorama.weight > 0
        share = _smoothed(seen.astype(np.float32))
        lit = _smoothed(np.where(seen, panorama.flux, np.float32(0)))
        flux = np.asarray(lit / np.maximum(share, np.float32(1e-6)), np.float32)
        # Next to an unseen pixel, the second derivative is unknown.
        inside = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
        blur = np.float32(_BLUR_PX**2 + _INTERPOLATION_PX2)
        sharp = np.maximum(flux - blur / 2 * cv2.Laplacian(flux, cv2.CV_32F, ksize=1), 0)
        mean = response.mean_count(np.asarray(sharp, np.float32))
        mean[~inside] = np.nan
        precision = np.asarray(1 / frame_variance(flux, response, response.mean_count), np.float32)
        precision[~inside] = 0
        frames_seen = float(np.median(panorama.weight[seen])) if seen.any() else 0.0
        remapped = not canvas.planar or (camera is not None and camera.distorts)
        ideal = _ideal(frame_shape, camera) if remapped else None
        return cls(canvas, mean, precision, trajectory, frame_shape, frames_seen, response, light, ideal, margin)

    def view(self, homography: Homography, into: NDArray[np.float32], span: FrameSpan | None = None) -> None:
        """Sample mean and precision at the pixels of a frame into (2, H, W) float32, NaN where the panorama was not seen.

        `homography` maps frame pixels to reference pixels; `span` is of the frames whose light is predicted, None for the mean.
        """
        self._sample(homography, into)
        if self.light is not None and span is not None:
            self._relight(into, gain_image(self.light, span, homography, self.frame_shape))

    def _relight(self, images: NDArray[np.float32], gain: FluxImage) -> None:
        """Replace mean and precision by those at `gain` times the flux."""
        mean, precision = images
        known = np.isfinite(mean) & (precision > 0)
        flux = self.response.flux(np.where(known, mean, np.float32(0)), _MANY_FRAMES)
        lit = np.asarray(gain * flux, np.float32)
        mean[:] = np.where(known, self.response.mean_count(lit), np.float32(np.nan))
        before, after = (frame_variance(each, self.response, self.response.mean_count) for each in (flux, lit))
        precision *= before / after

    def _sample(self, homography: Homography, into: NDArray[np.float32]) -> None:
        if self.ideal is not None:
            places = self.canvas.pixels(self.ideal @ (self.canvas.plane_to_rays @ homography).T)
            places[..., 0] += self.margin
            sample_places(self.mean, self.precision, places.astype(np.float32), into)
            return
        to_canvas = np.ascontiguousarray(self.canvas.transform @ homography)
        if self._straight(to_canvas):
            sample_view(self.mean, self.precision, to_canvas, into)
            return
        height, width = self.frame_shape
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for image, place in zip((self.mean, self.precision), into, strict=True):
            cv2.warpPerspective(image, to_canvas, (width, height), place, flags, cv2.BORDER_CONSTANT, float("nan"))

    def cells(self, homography: Homography, pixels: FloatArray) -> tuple[FloatArray, Homography]:
        """Return pixels of a frame, (h, w, 2), and the (3, 3) map from them to pixels of the panorama.

        Where no homography maps them, the places on the panorama are returned for the pixels, and the identity.
        """
        if self.ideal is None:
            return pixels, self.canvas.transform @ homography
        y, x = np.rint(np.moveaxis(pixels, -1, 0)[::-1]).astype(int)
        places = self.canvas.pixels(self.ideal[y, x] @ (self.canvas.plane_to_rays @ homography).T)
        return np.where(np.isfinite(places), places, -1e6), np.eye(3)

    def predicted(self, instant: float) -> tuple[FluxImage, FluxImage]:
        """Predict the frame of an instant: see `PanoramaView`."""
        images = np.empty((2, *self.frame_shape), np.float32)
        frame = max(0, round(float(instant)))
        self.view(self.trajectory.at([instant])[0], images, FrameSpan(frame, frame + 1))
        mean, precision = images
        known = np.isfinite(mean) & (precision > 0)
        mean[~known] = np.nan
        return mean, np.divide(1, precision, out=np.full_like(precision, np.nan), where=known)

    def _straight(self, to_canvas: Homography) -> bool:
        """Return whether neighbours on a row of the frame lie at neighbours on the canvas, over long runs."""
        x, y = corners(self.frame_shape).T
        depth = to_canvas[2, 0] * x + to_canvas[2, 1] * y + to_canvas[2, 2]
        u = (to_canvas[0, 0] * x + to_canvas[0, 1] * y + to_canvas[0, 2]) / depth
        v = (to_canvas[1, 0] * x + to_canvas[1, 1] * y + to_canvas[1, 2]) / depth
        along = np.abs(to_canvas[0, 0] / depth - u * to_canvas[2, 0] / depth - 1)
        across = np.abs(to_canvas[1, 0] / depth - v * to_canvas[2, 0] / depth)
        return bool(max(along.max(), across.max()) < 1 / _STRAIGHT_RUN_PX)


@dataclass(frozen=True, slots=True, eq=False)
class Predictions:
    """The predictions of all colours of a capture: a `PanoramaView`. A grey capture has one."""

    parts: tuple[tuple[Capture, Prediction], ...]  # the source of each colour, with its prediction. Their motion is the same.

    @classmethod
    def of(
        cls, source: Source, panorama: Panorama, canvas: Canvas, trajectory: Trajectory, frame_shape: tuple[int, int]
    ) -> Predictions:
        """Make the predictions of a panorama that was rendered along the trajectory, as `render` returns it for the source."""
        capture = capture_of(source)

        def prediction(each: Capture, single: Panorama) -> Prediction:
            seen = trajectory, frame_shape, capture.light, capture.camera
            return Prediction.of(single, canvas, each.response, *seen)

        if capture.colour is None:
            return cls(((capture, prediction(capture, panorama)),))
        images = zip(np.moveaxis(panorama.flux, -1, 0), np.moveaxis(panorama.weight, -1, 0), strict=True)
        singles = [
            Panorama(np.ascontiguousarray(flux), np.ascontiguousarray(weight), panorama.canvas) for flux, weight in images
        ]
        parts = zip(capture.colours().values(), singles, strict=True)
        return cls(tuple((each, prediction(each, single)) for each, single in parts))

    @property
    def first(self) -> Prediction:
        """The prediction of the first colour; motion, canvas and frame shape are those of all."""
        return self.parts[0][1]

    @property
    def frames_seen(self) -> float:
        """Frames that saw a place of the panorama, in any colour."""
        return sum(prediction.frames_seen for _, prediction in self.parts)

    def predicted(self, instant: float) -> tuple[FluxImage, FluxImage]:
        """Predict the frame of an instant, each pixel in its colour: see `PanoramaView`."""
        images = [prediction.predicted(instant) for _, prediction in self.parts]
        if len(images) == 1:
            return images[0]
        mean, variance = (np.full(self.first.frame_shape, np.nan, np.float32) for _ in range(2))
        for (source, _), (of_colour, its_variance) in zip(self.parts, images, strict=True):
            mean[source.valid], variance[source.valid] = of_colour[source.valid], its_variance[source.valid]
        return mean, variance


def _continued(panorama: Panorama, margin: int) -> Panorama:
    """Return a full turn with some columns of each end at the other end."""
    if not margin:
        return panorama
    flux, weight = (np.pad(each, ((0, 0), (margin, margin)), mode="wrap") for each in (panorama.flux, panorama.weight))
    return Panorama(flux, weight, panorama.canvas)


def _ideal(frame_shape: tuple[int, int], camera: Camera | None) -> FloatArray:
    """Return the homogeneous ideal pixels of the pixels of a frame: (H, W, 3)."""
    y, x = np.mgrid[: frame_shape[0], : frame_shape[1]]
    pixels = np.stack([x, y], axis=-1).astype(np.float64)
    ideal = pixels if camera is None else camera.ideal(pixels)
    return np.concatenate([ideal, np.ones((*frame_shape, 1))], axis=-1)


def _smoothed(image: FluxImage) -> FluxImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_CONSTANT), np.float32)
