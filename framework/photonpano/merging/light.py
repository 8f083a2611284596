"""Sums of frames in changing light: how many frames of which gain each pixel of a grid was seen in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of
from photonpano.contracts.protocols import Source
from photonpano.geometry import Canvas, inverse
from photonpano.values import FloatArray, FluxImage, FrameSpan, Homography, Light, Response

_ROUNDS = 8  # steps that solve for the flux of bright pixels in frames of different gains. Each at least halves the error
_ACCURACY = 1e-4  # the steps end when no flux changes by more than this share
_FAR = 1e4  # a place on a map of amplitudes that lies beyond its end, in px
_GRID_PX = 4  # between pixels at which places on a sphere are computed
_SEEN = 1e-3  # sums of less than this many frames are rounding errors


def bytes_of_light(source: Source) -> int:
    """Return the memory that the light of a capture takes for each pixel of a grid; 0 in steady light."""
    light = capture_of(source).light
    if light is None:
        return 0
    # Each coverage has two images; frames and gains, and their quotient, are three more for a class.
    return 4 * (int(light.classes().max()) + 1) * (2 * (2 + len(light.waves)) + 3)


@dataclass(frozen=True, slots=True, eq=False)
class LitFrames:
    """Frames and gains of the pixels of a grid, by the class of their light."""

    frames: FluxImage  # (C, H, W) float32, number of frames of each class in which a pixel was seen
    gains: FluxImage  # (C, H, W) float32, sum of the gains of the pixel in these frames

    @property
    def weight(self) -> FluxImage:
        """Sum of the gains of each pixel: (H, W), frames of mean light."""
        return np.asarray(self.gains.sum(axis=0), np.float32)

    def flux(self, counts: FluxImage, response: Response) -> FluxImage:
        """Return the flux of each pixel that explains its counts: `counts = sum_c frames_c mean_count(gain_c flux)`.

        Frames of one gain, and linear responses, need one step. Saturated pixels get a flux that is finite, and too small.
        """
        frames = np.maximum(self.frames.sum(axis=0), np.float32(1))
        total = np.maximum(self.weight, np.float32(_SEEN))
        # Subtraction of dark counts can leave a negative sum by chance.
        found = response.flux(np.asarray(np.maximum(counts, 0) / frames, np.float32), frames)
        flux = np.asarray(found * frames / total, np.float32)
        if len(self.frames) == 1:
            return flux
        gains = np.divide(self.gains, self.frames, out=np.zeros_like(self.gains), where=self.frames > _SEEN)
        for _ in range(_ROUNDS):
            mean = np.zeros_like(flux)
            for each, gain in zip(self.frames, gains, strict=True):
                mean += each / frames * response.mean_count(np.asarray(gain * flux, np.float32))
            seen = response.flux(mean, frames)
            better = np.where(np.abs(seen) > 1e-9, flux * found / np.where(np.abs(seen) > 1e-9, seen, 1), flux)
            change = np.abs(better - flux) > _ACCURACY * np.abs(flux)
            flux = np.asarray(better, np.float32)
            if not change.any():
                break
        return flux

    def part(self, box: tuple[slice, slice]) -> LitFrames:
        """Return copies of some rows and columns."""
        return LitFrames(self.frames[:, *box].copy(), self.gains[:, *box].copy())

    def weighted(self, by: FluxImage) -> LitFrames:
        """Return these frames with a weight for each pixel, (H, W)."""
        return LitFrames(self.frames * by, self.gains * by)


@dataclass(frozen=True, slots=True, eq=False)
class LightTerms:
    """What chunks of frames add to the coverages of a grid: for each class of light, frames and the terms of their gains."""

    light: Light  # of the capture
    classes: NDArray[np.int64]  # (T,) class of each frame
    present: tuple[int, ...]  # the classes of the frames that are summed, in order

    @classmethod
    def of(cls, light: Light, spans: Sequence[FrameSpan]) -> LightTerms:
        """Prepare to sum the frames of spans."""
        classes = light.classes()
        parts = [classes[span.start : span.stop] for span in spans]
        return cls(light, classes, tuple(np.unique(np.concatenate(parts)).tolist()) if parts else (0,))

    @property
    def number(self) -> int:
        """How many coverages there are."""
        return len(self.present) * (2 + len(self.light.waves))

    def amounts(self, span: FrameSpan) -> FloatArray:
        """Return what the frames of a span add to each coverage: (number,)."""
        terms = self.light.terms(span)
        values = np.concatenate([np.ones_like(terms[:1]), terms])
        of_class = self.classes[span.start : span.stop] == np.array(self.present)[:, None]
        return np.asarray((of_class.astype(float) @ values.T).ravel())

    def lit_frames(self, coverages: FluxImage, canvas: Canvas) -> LitFrames:
        """Return the frames and gains of each pixel, from (number, H, W) coverages of a canvas."""
        by_class = coverages.reshape(len(self.present), -1, *canvas.shape)
        gains = by_class[:, 1].copy()
        for index, image in enumerate(amplitudes_on(self.light, canvas)):
            gains += image * by_class[:, 2 + index]
        return LitFrames(np.ascontiguousarray(by_class[:, 0]), np.maximum(gains, 0))


def amplitudes_on(light: Light, canvas: Canvas) -> list[FluxImage]:
    """Return the amplitudes of the lamps at the pixels of a canvas, (H, W) for each map; beyond its end, those at the end."""
    _, height, width = light.maps.shape
    if light.camera_matrix is None and canvas.planar:
        flags, onto = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, light.to_map @ inverse(canvas.transform)
        size = canvas.width, canvas.height
        return [
            np.asarray(cv2.warpPerspective(each, onto, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))
            for each in light.maps
        ]
    projection = "planar" if light.camera_matrix is None else "spherical"
    maps = Canvas(height, width, light.to_map, projection, light.camera_matrix)
    # The squares of maps are larger than this grid, whose places take as long as a whole merge at each pixel.
    rows, columns = (np.arange(0, length + _GRID_PX, _GRID_PX, dtype=float) for length in canvas.shape)
    grid = canvas.on_plane(np.stack(np.meshgrid(columns, rows), axis=-1)) @ maps.plane_to_rays.T
    x, y = np.moveaxis(np.clip(np.nan_to_num(maps.pixels(grid), nan=_FAR), -1, _FAR).astype(np.float32), -1, 0)
    coarse = [cv2.remap(each, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for each in light.maps]
    finer = np.diag([_GRID_PX, _GRID_PX, 1.0])
    return [np.asarray(cv2.warpPerspective(each, finer, (canvas.width, canvas.height))) for each in coarse]


def gain_image(light: Light, span: FrameSpan, to_plane: Homography, shape: tuple[int, int]) -> FluxImage:
    """Return the mean gain of the pixels of a frame over a span: (H, W); see `amplitudes_on`."""
    gain, *waves = light.terms(span).mean(axis=1)
    image = np.full(shape, gain, np.float32)
    for wave, amplitude in zip(waves, amplitudes_on(light, Canvas(*shape, inverse(to_plane))), strict=True):
        image += np.float32(wave) * amplitude
    return np.maximum(image, np.float32(0))
