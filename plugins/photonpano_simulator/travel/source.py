"""Source `travel-simulator`: frames of a scene with depth are rendered when they are read."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano import FloatArray, SourceContext
from photonpano_simulator.source import SimulatedSource
from photonpano_simulator.travel.paths import camera_of, poses_of, require_free
from photonpano_simulator.travel.rendering import atlas_of, view_of
from photonpano_simulator.travel.stage import Stage, with_objects
from photonpano_simulator.travel.truth import TravelTruth, sharp_view
from photonpano_simulator.travel_config import TravelConfig

_METERED = 9  # frames along the path over which the mean flux is taken


class TravelSource(SimulatedSource):
    """A single-photon camera that travels through a scene with depth."""

    def __init__(self, config: TravelConfig, context: SourceContext) -> None:
        super().__init__(config, context)
        (stage, poses), camera = placed(config, self._seed), camera_of(config)
        scene = stage.drawn(context.threads)
        metered = view_of(scene.planes, atlas_of(scene.textures), camera, config.frame_shape)
        frames = np.linspace(0, len(poses) - 1, _METERED).astype(int)
        mean = float(np.mean([metered.flux(poses[frame], frame) for frame in frames]))
        self._truth = TravelTruth(
            poses[self._taken],
            camera,
            config.frame_shape,
            self._taken,
            self._light[self._taken],
            with_objects(scene, config.objects, poses[0], camera.matrix, config.frame_shape, mean),
            config.flux * config.sensor.quantum_efficiency / mean,
        )
        self._order = np.argsort(self._taken, kind="stable")
        # Rendered from the first thread on, it is made once.
        _ = self._truth.view

    def _incident(self, taken: int) -> NDArray[np.float32]:
        # Of a frame that is missing in the capture, the next one.
        place = min(int(np.searchsorted(self._taken, taken, sorter=self._order)), len(self._order) - 1)
        return sharp_view(self._truth, int(self._order[place])) * self._sensor.gains

    def truth(self) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth of the frames: `docs/how-to/simulate-depth.md` lists the arrays.

        Convention:
            Points of the world are (x, y, z) in m: x right, y down, z ahead. `camera_from_world` maps them to points of the
            camera, X_c = R X_w + t, with the same axes; pixels are K X_c, integers are pixel centres.
        """
        gains = {"gains": self._sensor.gains} if (self._sensor.gains != 1).any() else {}
        return {**super().truth(), **self._truth.arrays(), **gains}

    def sharp_view(self, frame: int) -> NDArray[np.float32]:
        """Return the flux of a frame without noise, dark counts and differences between pixels: (H, W)."""
        return sharp_view(self._truth, frame)


def placed(config: TravelConfig, seed: int) -> tuple[Stage, FloatArray]:
    """Place the scene and the poses of all frames, (T, 3, 4); raises an `InputError` if they do not suit each other."""
    stage = Stage(config)
    poses = poses_of(config, stage.middle, seed)
    require_free(poses, camera_of(config), config.frame_shape, stage.planes, stage.free)
    return stage, poses
