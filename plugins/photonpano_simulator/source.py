"""Source `simulator`: frames that are made when they are asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from photonpano import StreamInfo
from photonpano.photometry import BinaryResponse
from photonpano_simulator.chance import Draw, generator
from photonpano_simulator.paths import camera_path
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.sensor import SpadSensor

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from photonpano import FrameSpan, SourceContext
    from photonpano_simulator.config import SimulatorConfig


class SimulatorSource:
    """A single-photon camera that turns before a scene (paper, section 5, "Simulation Details").

    A frame depends on the config, the seed and its index alone: spans may be asked for in any order and from any thread.
    Where it falls between the pixels of the scene, the flux is interpolated linearly; a pixel has no extent.

    Raises:
        InputError: a file cannot be used, or the camera path leaves the scene.
    """

    def __init__(self, config: SimulatorConfig, context: SourceContext) -> None:
        self._seed = context.seed if config.seed is None else config.seed
        self._scene = scene_flux(config.scene, config.flux * config.sensor.quantum_efficiency)
        height, width = self._scene.shape
        self._homographies = camera_path(config, (height, width), self._seed)
        self._sensor = SpadSensor(config.sensor, config.frame_shape, self._seed)
        self.info = StreamInfo(config.n_frames, *config.frame_shape, config.frame_rate_hz)
        self.response = BinaryResponse()
        masked = config.sensor.mask_hot_pixels
        self.valid: NDArray[np.bool_] = ~self._sensor.hot if masked else np.ones(config.frame_shape, np.bool_)
        self.valid.flags.writeable = False

    def counts(self, span: FrameSpan) -> NDArray[np.uint32]:
        """Sum the frames of a span: (H, W) uint32."""
        self.info.require(span)
        counts = np.zeros(self.info.frame_shape, np.uint32)
        for index in range(span.start, span.stop):
            counts += self._frame(index)
        return counts

    def frames(self, span: FrameSpan) -> NDArray[np.uint8]:
        """Return the frames of a span: (n, H, W) of zeros and ones."""
        self.info.require(span)
        frames = np.empty((len(span), *self.info.frame_shape), np.uint8)
        for place, index in enumerate(range(span.start, span.stop)):
            frames[place] = self._frame(index)
        return frames

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return what the frames show.

        Convention:
            Homographies map pixels of a frame to pixels of the scene; points are (x, y), integers are pixel centres.

        Returns:
            `homographies` (T, 3, 3) float64; `scene` (Hs, Ws) float32, the flux that is detected, in photons per pixel per
            frame period, without dark counts; `frame_shape` (2,); `frame_rate_hz` (); `dark_rates` (H, W) float32, dark
            counts per frame period; `hot_pixels` (H, W) bool; `seed` ().
        """
        return {
            "homographies": self._homographies,
            "scene": self._scene,
            "frame_shape": np.array(self.info.frame_shape),
            "frame_rate_hz": np.array(self.info.frame_rate_hz),
            "dark_rates": self._sensor.dark_rates,
            "hot_pixels": self._sensor.hot,
            "seed": np.array(self._seed),
        }

    def close(self) -> None:
        """Do nothing: there is no file to let go of."""

    def __enter__(self) -> SimulatorSource:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _frame(self, index: int) -> NDArray[np.bool_]:
        height, width = self.info.frame_shape
        flux = cv2.warpPerspective(
            self._scene,
            self._homographies[index],
            (width, height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            # The path lies inside the scene, but for the rounding of its last decimal.
            borderMode=cv2.BORDER_REPLICATE,
        ).astype(np.float32, copy=False)
        return self._sensor.expose(flux, generator(self._seed, Draw.PHOTONS, index))
