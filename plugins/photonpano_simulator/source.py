"""Sources `simulator` and `camera-simulator`: frames are rendered when they are read."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import FrameSpan, SourceContext, StreamInfo
from photonpano.geometry import corner_displacements, inverse
from photonpano.reading import Closing
from photonpano_simulator.config import CameraSimulatorConfig, IntensitySensor, SimulatorConfig
from photonpano_simulator.intensity import IntensityCamera
from photonpano_simulator.paths import camera_path
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.sensor import Draw, SpadSensor, generator


class SimulatorSource(Closing):
    """A camera that rotates in front of a scene (paper, section 5, "Simulation Details").

    A frame depends only on the config, the seed and its index, so spans may be read in any order and from any thread. The flux
    between the pixels of the scene is interpolated linearly; pixels of the camera have no extent.

    Raises:
        InputError: a file cannot be used, or the camera path leaves the scene.
    """

    def __init__(self, config: SimulatorConfig | CameraSimulatorConfig, context: SourceContext) -> None:
        self._seed = context.seed if config.seed is None else config.seed
        self._scene = scene_flux(config.scene, config.flux * config.sensor.quantum_efficiency)
        height, width = self._scene.shape
        self._homographies = camera_path(config, (height, width), self._seed)
        self._sensor: SpadSensor | IntensityCamera
        if isinstance(config.sensor, IntensitySensor):
            self._sensor = IntensityCamera(config.sensor, config.frame_shape)
        else:
            self._sensor = SpadSensor(config.sensor, config.frame_shape, self._seed)
        self.info = StreamInfo(config.n_frames, *config.frame_shape, config.frame_rate_hz, self._sensor.kind, self._sensor.bits)
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
            `homographies` (T, 3, 3) float64; `scene` (Hs, Ws) float32, the flux that is detected, in photons per pixel per
            frame period, without dark counts; `frame_shape` (2,); `frame_rate_hz` (); `seed` (); of a single-photon camera also
            `dark_rates` (H, W) float32, dark counts per frame period, and `hot_pixels` (H, W) bool.
        """
        return {
            "homographies": self._homographies,
            "scene": self._scene,
            "frame_shape": np.array(self.info.frame_shape),
            "frame_rate_hz": np.array(self.info.frame_rate_hz),
            "seed": np.array(self._seed),
            **self._sensor.truth(),
        }

    def _frame(self, index: int) -> NDArray[np.bool_] | NDArray[np.uint16]:
        views = [self._view(homography) for homography in self._while_open(index)]
        flux = views[0] if len(views) == 1 else np.mean(views, axis=0)
        return self._sensor.expose(flux, generator(self._seed, Draw.PHOTONS, index))

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

    def _view(self, homography: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the flux of the scene in a frame, (H, W)."""
        height, width = self.info.frame_shape
        return cv2.warpPerspective(
            self._scene,
            homography,
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            # The path lies inside the scene, up to rounding errors.
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.float32, copy=False)
