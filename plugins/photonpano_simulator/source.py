"""Sources `simulator` and `camera-simulator`: frames are rendered when they are read."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, SourceContext, StreamInfo
from photonpano.geometry import apply, corner_displacements, corners, inverse, translation
from photonpano.reading import Closing
from photonpano_simulator.config import CameraSimulatorConfig, IntensitySensor, Sensor, SimulatorConfig
from photonpano_simulator.delivery import delivered
from photonpano_simulator.intensity import IntensityCamera
from photonpano_simulator.lamps import brightness, shares
from photonpano_simulator.lens import distorts, pixel_grid, transmission, undistorted
from photonpano_simulator.objects import DrawnObject
from photonpano_simulator.paths import camera_path, scene_motion
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.sensor import Draw, SpadSensor, bayer_of, filter_array, generator


class SimulatorSource(Closing):
    """A camera that rotates in front of a scene (paper, section 5, "Simulation Details").

    A frame depends only on the config, the seed and its index, so spans may be read in any order and from any thread. The flux
    between the pixels of the scene is interpolated linearly. Pixels of the camera have an area if the scene is finer than they
    are: its flux is averaged over whole pixels of the scene, and the averages are interpolated.

    Raises:
        InputError: a file cannot be used, the camera path leaves the scene, or frames are dropped that do not exist.
    """

    def __init__(self, config: SimulatorConfig | CameraSimulatorConfig, context: SourceContext) -> None:
        self._seed = context.seed if config.seed is None else config.seed
        flux = config.flux * config.sensor.quantum_efficiency
        filters = filter_array(config.sensor, config.frame_shape) if isinstance(config.sensor, Sensor) else None
        self._filters = filters
        self._scene = scene_flux(config.scene, flux, in_colour=filters is not None)
        height, width = self._scene.shape[:2]
        self._homographies = camera_path(config, (height, width), self._seed)
        # The side of the area of a pixel, in px of the scene. Averages over it are sampled where their middles lie.
        side = max(1, round(config.scene_scale * config.fill_factor**0.5))
        self._averages = _averaged(self._scene, side)
        self._to_averages = translation(-(side - 1) / 2, -(side - 1) / 2)
        self._taken = delivered(config)
        self._lens = config.lens
        self._points = None
        if distorts(config.lens):
            self._points = undistorted(config.lens, pixel_grid(config.frame_shape), config.frame_shape)
        motion = scene_motion(self._homographies, config.frame_shape) if config.objects else np.zeros((config.n_frames, 2))
        self._objects = [DrawnObject(each, config.frame_shape, flux, motion) for each in config.objects]
        self._light = config.drift ** np.linspace(0, 1, config.n_frames)
        self._lamps = shares(config.lamps, (height, width))
        self._lit_parts = [_averaged(np.ascontiguousarray((self._scene.T * share.T).T), side) for share in self._lamps]
        self._lamp_light = np.zeros((len(config.lamps), config.n_frames))
        for place, lamp in enumerate(config.lamps):
            self._lamp_light[place] = brightness(lamp, config.n_frames, config.frame_rate_hz)
        self._sensor: SpadSensor | IntensityCamera
        if isinstance(config.sensor, IntensitySensor):
            self._sensor = IntensityCamera(config.sensor, config.frame_shape)
        else:
            self._sensor = SpadSensor(config.sensor, config.frame_shape, self._seed)
        self._gains = transmission(config.lens, config.frame_shape) * self._sensor.gains
        self._is_uniform = bool(np.all(self._gains == 1)) and config.drift == 1
        kind, bits = self._sensor.kind, self._sensor.bits
        self.info = StreamInfo(len(self._taken), *config.frame_shape, config.frame_rate_hz, kind, bits, bayer_of(config.sensor))
        self.response = self._sensor.response
        self.valid: NDArray[np.bool_] = self._sensor.valid
        self.valid.flags.writeable = False

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for index in range(span.start, span.stop):
            counts += self._frame(index)
        return counts

    def frames(self, span: FrameSpan) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Return the frames of a span: (n, H, W) of zeros and ones, or of grey levels."""
        self.info.require(span)
        shape = len(span), *self.info.frame_shape
        frames: NDArray[np.uint8] | NDArray[np.uint16]
        frames = np.empty(shape, np.uint8) if self.info.bit_depth <= 8 else np.empty(shape, np.uint16)
        for place, index in enumerate(range(span.start, span.stop)):
            frames[place] = self._frame(index)
        return frames

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the frames.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres.

        Returns:
            `homographies` (T, 3, 3) float64, those of a lens without distortion; `scene` (Hs, Ws) float32, the flux that is
            detected, in photons per pixel per frame period, without dark counts; `frame_shape` (2,); `frame_rate_hz` ();
            `seed` (); of a sensor with colour filters, `scene` is (Hs, Ws, 3), of red, green and blue pixels, and `filters`
            (H, W, 3) uint8 what each pixel sees, 255 or 0; of a single-photon camera also `dark_rates` (H, W) float32, dark
            counts per frame period, and
            `hot_pixels` (H, W) bool. Captures that are disturbed have more: `distortion` (2,), k1 and k2 of the lens, and
            `undistorted_corners` (4, 2), where a lens without distortion images the corners of the frame; `gains` (H, W)
            float32, vignetting, sensitivity and dirt; `light` (T,), relative to the first frame; `lamps` (N, Hs, Ws) float32,
            the share of each lamp in the light of each place, and `lamp_light` (N, T), 1 on average; `taken` (T,), the index
            of each frame before drops and repeats.
        """
        truth: dict[str, NDArray[np.generic]] = {
            "homographies": self._homographies[self._taken],
            "scene": self._scene,
            "frame_shape": np.array(self.info.frame_shape),
            "frame_rate_hz": np.array(self.info.frame_rate_hz),
            "seed": np.array(self._seed),
            **self._sensor.truth(),
        }
        if self._filters is not None:
            truth["filters"] = (255 * self._filters).astype(np.uint8)
        if self._points is not None:
            truth["distortion"] = np.array([self._lens.k1, self._lens.k2])
            truth["undistorted_corners"] = undistorted(self._lens, corners(self.info.frame_shape), self.info.frame_shape)
        if (self._gains != 1).any():
            truth["gains"] = self._gains
        if (self._light != 1).any():
            truth["light"] = self._light[self._taken]
        if len(self._lamps):
            truth["lamps"], truth["lamp_light"] = self._lamps, self._lamp_light[:, self._taken]
        if not np.array_equal(self._taken, np.arange(len(self._homographies))):
            truth["taken"] = self._taken
        return truth

    def _frame(self, index: int) -> NDArray[np.bool_] | NDArray[np.uint16]:
        taken = int(self._taken[index])
        views = [self._lit_view(taken, homography) for homography in self._while_open(taken)]
        flux = views[0] if len(views) == 1 else np.mean(views, axis=0)
        for each in self._objects:
            each.draw(flux, taken)
        if not self._is_uniform:
            flux *= self._gains * np.float32(self._light[taken])
        return self._sensor.expose(flux, generator(self._seed, Draw.PHOTONS, taken))

    def _lit_view(self, index: int, homography: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the flux of the scene in a frame, in the light of the lamps: (H, W)."""
        flux = self._view(self._averages, homography)
        for part, light in zip(self._lit_parts, self._lamp_light[:, index], strict=True):
            flux += np.float32(light - 1) * self._view(part, homography)
        return flux

    def _while_open(self, index: int) -> NDArray[np.float64]:
        """Return homographies of a frame while its shutter is open, (n, 3, 3): evenly spaced in time, about a pixel apart."""
        at = self._homographies[index]
        if not self._sensor.exposure or len(self._homographies) == 1:
            return np.asarray(at[None])
        last = len(self._homographies) - 1
        before, after = max(index - 1, 0), min(index + 1, last)
        velocity: NDArray[np.float64] = (self._homographies[after] - self._homographies[before]) / (after - before)
        way = velocity * self._sensor.exposure
        there = inverse(at - way / 2) @ (at + way / 2)
        n = max(1, int(np.ceil(corner_displacements(there, np.eye(3), self.info.frame_shape).max())))
        return np.asarray(at + way * ((np.arange(n) + 0.5) / n - 0.5)[:, None, None])

    def _view(self, scene: NDArray[np.float32], homography: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the flux of a scene in a frame, (H, W)."""
        height, width = self.info.frame_shape
        homography = self._to_averages @ homography
        # The path lies inside the scene, up to rounding errors.
        border = cv2.BORDER_REPLICATE
        if self._points is None:
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            view = cv2.warpPerspective(scene, homography, (width, height), flags=flags, borderMode=border)
        else:
            x, y = np.moveaxis(apply(homography, self._points.reshape(-1, 2)).reshape(height, width, 2), -1, 0).astype(
                np.float32
            )
            view = cv2.remap(scene, x, y, cv2.INTER_LINEAR, borderMode=border)
        if self._filters is not None:
            view = (view * self._filters).sum(axis=-1)
        return view.astype(np.float32, copy=False)


def _averaged(scene: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Return the averages of squares of pixels of a scene, each where its first pixel lies."""
    if side == 1:
        return scene
    averages = cv2.boxFilter(scene, -1, (side, side), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(averages, np.float32)
