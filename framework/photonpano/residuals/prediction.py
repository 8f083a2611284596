"""Predict the photons of frames from the panorama and the motion."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import Capture, capture_of
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.geometry import Camera, Canvas
from photonpano.merging.accumulate import gain_image
from photonpano.merging.warping import NODES_PX, Texture, sample
from photonpano.photometry import frame_variance
from photonpano.values import FloatArray, FluxImage, FrameSpan, Homography, Light, Panorama, Response

_BLUR_PX = 0.7  # standard deviation of the Gaussian that smooths the panorama: its noise must not pass for texture
_INTERPOLATION_PX2 = 1 / 6  # variance of the kernel of one linear interpolation, averaged over the fractions of a pixel
_SATURATED, _BESIDE_PX = 0.98, 9  # share of the highest count from which on a place, and the square around it, tell nothing
_MANY_FRAMES = 1e4  # of a mean count that is exact
_NODES_ERROR_PX = 0.005  # error of places that are interpolated between exact ones
_MARGIN = 4  # columns with which a full turn is continued on each side: more than the smoothing reaches


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Prediction:
    """The panorama, in one colour, as the camera would see it from any instant: a `PanoramaView`.

    The panorama is smoothed, and then sharpened by as much as smoothing and interpolation have blurred it, to second order. So
    its noise is low and its edges are where they were.
    """

    canvas: Canvas  # of the panorama
    # expected count of a frame, an image (H, W). Of a full turn, it has `margin` columns more on each side, which continue on
    # the other side.
    mean: Texture
    # (H + 2, W + 1) float32, variance of the count of a frame, in a border of zeros; 0 where the panorama, or a place up to two
    # pixels away, was not seen
    variance: FluxImage
    trajectory: Trajectory
    frame_shape: tuple[int, int]  # (height, width) of a frame
    frames_seen: float  # frames that saw a place of the panorama, the median over its pixels
    response: Response  # of the camera
    light: Light | None = None  # the gain of each frame; None in steady light
    camera: Camera | None = None  # whose lens distorts; None if none does
    margin: int = 0  # see `mean`
    _kept_nodes: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        panorama: Panorama,
        canvas: Canvas,
        response: Response,
        *,
        trajectory: Trajectory,
        frame_shape: tuple[int, int],
        light: Light | None = None,
        camera: Camera | None = None,
    ) -> Prediction:
        """Make the prediction of a panorama that was rendered along the trajectory, frame pixels to reference pixels."""
        margin = _MARGIN if canvas.is_full_turn else 0
        if margin:  # some columns of each end stand at the other end, too
            images = panorama.flux, panorama.weight
            flux, weight = (np.pad(each, ((0, 0), (margin, margin)), mode="wrap") for each in images)
            panorama = Panorama(flux, weight, panorama.canvas)
        seen = panorama.weight > 0
        share = _smoothed(seen.astype(np.float32))
        lit = _smoothed(np.where(seen, panorama.flux, np.float32(0)))
        flux = np.asarray(lit / np.maximum(share, np.float32(1e-6)), np.float32)
        # Next to an unseen pixel, the second derivative is unknown.
        inside = cv2.erode(seen.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
        blur = np.float32(_BLUR_PX**2 + _INTERPOLATION_PX2)
        sharp = np.maximum(flux - blur / 2 * cv2.Laplacian(flux, cv2.CV_32F, ksize=1), 0)
        mean = response.mean_count(np.asarray(sharp, np.float32))
        # The gradient at a place is that of interpolated pixels up to two away.
        known = cv2.erode(
            inside.astype(np.uint8), np.ones((5, 5), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
        ).astype(np.bool_)
        # Beside what saturates a pixel, the panorama is smoothed, and its counts are interpolated, over a hundredfold contrast.
        highest = response.mean_count(np.array([np.inf], np.float32))
        saturated = (mean > _SATURATED * highest).astype(np.uint8)
        known &= cv2.dilate(saturated, np.ones((_BESIDE_PX, _BESIDE_PX), np.uint8)) == 0
        variance = np.where(known, frame_variance(flux, response, response.mean_count), np.float32(0))
        variance = np.pad(variance.astype(np.float32, copy=False), ((1, 1), (1, 0)))
        frames_seen = float(np.median(panorama.weight[seen])) if seen.any() else 0.0
        texture = Texture.of(np.where(inside, mean, np.float32(0)))
        lens = camera if camera is not None and camera.distorts else None
        return cls(
            canvas=canvas,
            mean=texture,
            variance=variance,
            trajectory=trajectory,
            frame_shape=frame_shape,
            frames_seen=frames_seen,
            response=response,
            light=light,
            camera=lens,
            margin=margin,
        )

    def view(self, homography: Homography, into: NDArray[np.float32], span: FrameSpan | None = None) -> None:
        """Sample mean and variance at the pixels of a frame into (2, H, W) float32; the variance is 0 where they are not known.

        `homography` maps frame pixels to reference pixels; `span` is of the frames whose light is predicted, None for the mean.
        """
        self._sample(homography, into)
        if self.light is not None and span is not None:  # of `gain` times the flux
            # Frames that are left out have no photons, and the others the gain that is theirs.
            shown = float(self.light.shown[span.start : span.stop].mean())
            gain = gain_image(self.light, span, homography, self.frame_shape) / max(shown, 1e-9)
            mean, variance = into
            flux = self.response.flux(mean, _MANY_FRAMES)
            lit = np.asarray(gain * flux, np.float32)
            mean[:] = shown * self.response.mean_count(lit)
            before, after = (frame_variance(each, self.response, self.response.mean_count) for each in (flux, lit))
            variance *= shown * after / before

    def _sample(self, homography: Homography, into: NDArray[np.float32]) -> None:
        step = min(NODES_PX)
        if self._homographic:
            depth = self.canvas.transform[2:] @ homography
            bend = abs(depth[0, 0]) + abs(depth[0, 1])
            step = next((each for each in NODES_PX if each**2 / 4 * bend < _NODES_ERROR_PX * abs(depth[0, 2])), step)
        places = self._places(homography, self._nodes(step))
        period, first = self.canvas.period_px, 0.0
        if period is not None:
            # Neighbours are on the same turn.
            middle = places[places.shape[0] // 2, places.shape[1] // 2, 0]
            places[..., 0] -= period * np.round((places[..., 0] - middle) / period)
            first = min(-0.5, (self.canvas.width - 1 - period) / 2) + self.margin
        places[..., 0] += self.margin
        sample(self.mean, self.variance, places.astype(np.float32), step, (first, period or np.inf), into)

    @property
    def _homographic(self) -> bool:
        """Whether homographies map pixels of a frame to the panorama."""
        return self.canvas.planar and self.camera is None

    def _nodes(self, step: int) -> FloatArray:
        """Return the homogeneous ideal pixels of every `step`th pixel along y and x, and of one beyond the last: (h, w, 3)."""
        if step not in self._kept_nodes:
            y, x = (np.arange(-(-length // step) + 1.0) * step for length in self.frame_shape)
            self._kept_nodes[step] = self.ideal(np.stack(np.meshgrid(x, y), axis=-1))
        return self._kept_nodes[step]

    def ideal(self, pixels: FloatArray) -> FloatArray:
        """Return the homogeneous ideal pixels of pixels (..., 2) of a frame: (..., 3)."""
        ideal = pixels if self.camera is None else self.camera.ideal(pixels)
        return np.concatenate([ideal, np.ones((*pixels.shape[:-1], 1))], axis=-1)

    def _places(self, homography: Homography, ideal: FloatArray) -> FloatArray:
        """Return where homogeneous ideal pixels lie on the panorama: (..., 2); NaN behind a plane."""
        return self.canvas.pixels(ideal @ (self.canvas.plane_to_rays @ homography).T)

    def cells(self, homography: Homography, pixels: FloatArray, ideal: FloatArray) -> tuple[FloatArray, Homography]:
        """Return pixels of a frame, (h, w, 2), and the (3, 3) map from them to pixels of the panorama.

        Where no homography maps them, the places on the panorama are returned for the pixels, and the identity. `ideal` are
        the homogeneous ideal pixels, from `ideal`.
        """
        if self._homographic:
            return pixels, self.canvas.transform @ homography
        places = self._places(homography, ideal)
        return np.where(np.isfinite(places), places, -1e6), np.eye(3)

    def predicted(self, instant: float) -> tuple[FluxImage, FluxImage]:
        """Predict the frame of an instant: see `PanoramaView`."""
        images = np.empty((2, *self.frame_shape), np.float32)
        frame = max(0, round(float(instant)))
        self.view(self.trajectory.at([instant])[0], images, FrameSpan(frame, frame + 1))
        images[:, ~(images[1] > 0)] = np.nan  # the variance of relit darkness is NaN
        return images[0], images[1]


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
            return Prediction.of(
                single,
                canvas,
                each.response,
                trajectory=trajectory,
                frame_shape=frame_shape,
                light=each.light,
                camera=capture.camera,
            )

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
        seen = [prediction.frames_seen for _, prediction in self.parts]
        return max(seen) if self.in_channels else sum(seen)

    @property
    def in_channels(self) -> bool:
        """Whether every pixel sees all colours, in frames of their own; otherwise, each sees one."""
        return self.parts[0][0].source is not self.parts[-1][0].source

    def predicted(self, instant: float) -> tuple[FluxImage, FluxImage]:
        """Predict the grey frame of an instant, each pixel in its colour: see `PanoramaView`."""
        images = [prediction.predicted(instant) for _, prediction in self.parts]
        if len(images) == 1:
            return images[0]
        if self.in_channels:  # a pixel is dark if it is in all channels
            dark = np.prod([1 - of_colour for of_colour, _ in images], axis=0)
            return 1 - dark, dark * (1 - dark)
        mean, variance = (np.full(self.first.frame_shape, np.nan, np.float32) for _ in range(2))
        for (source, _), (of_colour, its_variance) in zip(self.parts, images, strict=True):
            mean[source.valid], variance[source.valid] = of_colour[source.valid], its_variance[source.valid]
        return mean, variance


def _smoothed(image: FluxImage) -> FluxImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR_PX, borderType=cv2.BORDER_CONSTANT), np.float32)
