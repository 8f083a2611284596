"""Sources `simulator` and `camera-simulator`: frames are rendered when they are read."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, FrameSpan, SourceContext, StreamInfo
from photonpano.geometry import corner_displacements, corners, inverse
from photonpano.reading import SingleFrameSource
from photonpano_simulator.camera import (
    DrawnObject,
    IntensityCamera,
    SpadSensor,
    Views,
    bayer_of,
    camera,
    distorts,
    filter_array,
    transmission,
    undistorted,
)
from photonpano_simulator.config import (
    CameraSimulatorConfig,
    IntensitySensor,
    Sensor,
    SimulatorConfig,
    TurnPath,
    delivered,
    within,
)
from photonpano_simulator.foreground import Foreground
from photonpano_simulator.paths import camera_path, camera_positions, camera_rotations, scene_motion
from photonpano_simulator.scenes import brightness, scene_flux, shares
from photonpano_simulator.travel_config import TravelConfig

_LABELLED_EVERY, _LABELLED_AT_MOST = 25, 400  # frames


class SimulatedSource(SingleFrameSource, ABC):
    """A simulated camera, whose frames depend only on the config, the seed and their index."""

    def __init__(self, config: SimulatorConfig | CameraSimulatorConfig | TravelConfig, context: SourceContext) -> None:
        self._seed = context.seed if config.seed is None else config.seed
        self._taken = delivered(config.n_frames, config.drops, config.repeats)
        self._light: FloatArray = config.drift ** np.linspace(0, 1, config.n_frames)
        self._sensor: SpadSensor | IntensityCamera
        if isinstance(config.sensor, IntensitySensor):
            self._sensor = IntensityCamera(config.sensor, config.frame_shape, self._seed)
        else:
            self._sensor = SpadSensor(config.sensor, config.frame_shape, self._seed)
        kind, bits, bayer = self._sensor.kind, self._sensor.bits, bayer_of(config.sensor)
        self.info = StreamInfo(len(self._taken), *config.frame_shape, config.frame_rate_hz, kind, bits, bayer)
        self.response = self._sensor.response
        self.valid: NDArray[np.bool_] = self._sensor.valid
        self.valid.flags.writeable = False

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of any camera: shape, rate, seed, and that of its sensor."""
        return {
            "frame_shape": np.array(self.info.frame_shape),
            "frame_rate_hz": np.array(self.info.frame_rate_hz),
            "seed": np.array(self._seed),
            **self._sensor.truth(),
        }

    def frame(self, index: int) -> NDArray[np.bool_] | NDArray[np.uint16]:
        """Return a frame: (H, W) of zeros and ones, or of grey levels."""
        return self._sensor.frame(int(self._taken[index]), self._incident)

    @abstractmethod
    def _incident(self, taken: int) -> NDArray[np.float32]:
        """Return the flux at the pixels in a frame that the camera takes, after their gains: (H, W), a new array."""


class SimulatorSource(SimulatedSource):
    """A camera that rotates in front of a scene (paper, section 5, "Simulation Details")."""

    def __init__(self, config: SimulatorConfig | CameraSimulatorConfig, context: SourceContext) -> None:
        super().__init__(config, context)
        flux = config.flux * config.sensor.quantum_efficiency
        filters = filter_array(config.sensor, config.frame_shape) if isinstance(config.sensor, Sensor) else None
        self._filters = filters
        is_round = isinstance(config.path, TurnPath)
        self._scene = scene_flux(config.scene, flux, in_colour=filters is not None, is_round=is_round)
        height, width = self._scene.shape[:2]
        self._homographies = camera_path(config, (height, width), self._seed)
        self._config, self._views = config, Views(config)
        self._averages = self._views.averaged(self._scene)
        motion = (
            scene_motion(self._homographies, config.frame_shape, config.path)
            if config.objects
            else np.zeros((config.n_frames, 2))
        )
        self._objects = [DrawnObject(each, config.frame_shape, flux, motion) for each in config.objects]
        rotations = camera_rotations(config, self._homographies, (height, width))
        self._foreground = Foreground(config, rotations, flux)
        self._is_dark = within(config.shutter, config.n_frames)
        self._lamps = shares(config.lamps, (height, width), is_round)
        self._lit_parts = [self._views.averaged(np.ascontiguousarray((self._scene.T * share.T).T)) for share in self._lamps]
        self._lamp_light = np.zeros((len(config.lamps), config.n_frames))
        for place, lamp in enumerate(config.lamps):
            self._lamp_light[place] = brightness(lamp, config.n_frames, config.frame_rate_hz)
        self._gains = transmission(config.lens, config.frame_shape) * self._sensor.gains
        self._is_uniform = bool(np.all(self._gains == 1)) and config.drift == 1

    def _incident(self, taken: int) -> NDArray[np.float32]:
        flux = self._flux(taken)
        if not self._is_uniform:
            flux *= self._gains * np.float32(self._light[taken])
        return flux

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the frames.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres. Of a path
            of the kind `turn`, the scene is an equirectangular panorama, and they map to pixels of the same camera when it
            looks level at the middle of the scene: K R K^-1 with determinant 1. Directions are x right, y down, z ahead.

        Returns:
            `homographies` (T, 3, 3) float64, those of a lens without distortion; `scene` (Hs, Ws) float32, the flux that is
            detected, in photons per pixel per frame period, without dark counts; `frame_shape` (2,); `frame_rate_hz` ();
            `seed` (). Unless the path is a file: `rotations` (T, 3, 3), directions of the frame camera to those of a camera
            that looks straight at the middle of the scene, and `camera_matrix` (3, 3). `scene_projection`, "planar" or
            "spherical". Of a sensor with colour filters, `scene` is (Hs, Ws, 3), of red, green and blue pixels, and `filters`
            (H, W, 3) uint8 what each pixel sees, 255 or 0; of a single-photon camera also `dark_rates` (H, W) float32, dark
            counts per frame period, and `hot_pixels` (H, W) bool. Captures that are disturbed have more: `distortion`, (4,)
            k1, k2, p1, p2 of OpenCV or (2,) k1 and k2 of `lens`, and `undistorted_corners` (4, 2), where a lens without
            distortion images the corners of the frame; `gains` (H, W) float32, vignetting, sensitivity and dirt; `light` (T,),
            relative to the first frame; `shutter_open` (T,) bool; `camera_positions` (T, 3), in m from the first, x right, y
            down, z ahead; `lamps` (N, Hs, Ws) float32, the share of each lamp in the light of each place, and
            `lamp_light` (N, T), 1 on average; `taken` (T,), the index of each frame before drops and repeats. With boards,
            people or objects, of every 25th frame, or of 400 frames: `labelled_frames` (N,), their indices; `labels`
            (N, H, W) uint8, 0 where they see the scene, else a place in `label_kinds`, which begins with "scene";
            `background` (N, H, ceil(W / 8)) uint8, packed along the width, 1 where they see the scene and the shutter is open;
            with boards or people, `depth` (N, H, W) float32, along the optical axis in m, infinite for the scene and NaN for
            objects.
        """
        truth: dict[str, NDArray[np.generic]] = {
            "homographies": self._homographies[self._taken],
            "scene": self._scene,
            "scene_projection": np.array("spherical" if isinstance(self._config.path, TurnPath) else "planar"),
            **super().truth(),
        }
        rotations = camera_rotations(self._config, self._homographies[self._taken], self._scene.shape[:2])
        if rotations is not None:
            truth["rotations"], truth["camera_matrix"] = rotations, camera(self._config).matrix
        if self._filters is not None:
            truth["filters"] = (255 * self._filters).astype(np.uint8)
        if distorts(self._config):
            lens, opencv = self._config.lens, self._config.distortion.coefficients
            truth["distortion"] = np.array(opencv if any(opencv) else (lens.k1, lens.k2))
            truth["undistorted_corners"] = undistorted(self._config, corners(self.info.frame_shape))
        if (self._gains != 1).any():
            truth["gains"] = self._gains
        if (self._light != 1).any():
            truth["light"] = self._light[self._taken]
        if self._is_dark.any():
            truth["shutter_open"] = ~self._is_dark[self._taken]
        if any(getattr(self._config.path, "travel_m", ())):
            truth["camera_positions"] = camera_positions(self._config.path, self._config.n_frames)[self._taken]
        if self._foreground.kinds or self._objects:
            truth |= self._labels()
        if len(self._lamps):
            truth["lamps"], truth["lamp_light"] = self._lamps, self._lamp_light[:, self._taken]
        if not np.array_equal(self._taken, np.arange(len(self._homographies))):
            truth["taken"] = self._taken
        return truth

    def _labels(self) -> dict[str, NDArray[np.generic]]:
        """Return what covers the pixels of some frames."""
        n_frames, shape = self.info.n_frames, self.info.frame_shape
        frames = np.arange(0, n_frames, max(_LABELLED_EVERY, -(-n_frames // _LABELLED_AT_MOST)))
        labels = np.zeros((len(frames), *shape), np.uint8)
        depth = np.full(labels.shape, np.inf, np.float32)
        for taken, of_frame, far in zip(self._taken[frames], labels, depth, strict=True):
            self._foreground.mark(of_frame, far, taken)
            for place, each in enumerate(self._objects, len(self._foreground.kinds) + 1):
                there = each.covered(shape, taken) > 0.5
                of_frame[there], far[there] = place, np.nan
        is_seen = (labels == 0) & ~self._is_dark[self._taken[frames], None, None]
        kinds = np.array(["scene", *self._foreground.kinds, *["object"] * len(self._objects)])
        found: dict[str, NDArray[np.generic]] = {
            "labelled_frames": frames,
            "labels": labels,
            "label_kinds": kinds,
            "background": np.packbits(is_seen, axis=-1),
        }
        if self._foreground.kinds:
            found["depth"] = depth
        return found

    def sharp_view(self, frame: int) -> NDArray[np.float32]:
        """Return the flux of a frame, (H, W), without noise, dark counts and differences between pixels but their filters."""
        self.info.require(FrameSpan(frame, frame + 1))
        taken = int(self._taken[frame])
        return self._flux(taken) * np.float32(self._light[taken])

    def _flux(self, taken: int) -> NDArray[np.float32]:
        """Return the flux of a frame that the camera takes, before its gains: (H, W)."""
        if self._is_dark[taken]:
            return np.zeros(self.info.frame_shape, np.float32)
        views = [self._lit_view(taken, homography) for homography in self._while_open(taken)]
        flux = views[0] if len(views) == 1 else np.mean(views, axis=0)
        self._foreground.draw(flux, taken)
        for each in self._objects:
            each.draw(flux, taken)
        return flux

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
        view = self._views.view(scene, homography)
        if self._filters is not None:
            view = (view * self._filters).sum(axis=-1)
        return view.astype(np.float32, copy=False)
