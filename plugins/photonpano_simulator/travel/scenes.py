"""The scenes by their names, with what moves in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from photonpano import FloatArray
from photonpano_simulator.objects import texture_of
from photonpano_simulator.scenes import photograph
from photonpano_simulator.travel import facade, panels, room
from photonpano_simulator.travel.building import Builder, Scene
from photonpano_simulator.travel.config import TravelConfig, WorldObject
from photonpano_simulator.travel.planes import Planes

_SCENES = {"room": room, "facade": facade, "planes": panels}


class Stage:
    """A scene that is placed, and not drawn yet.

    Args:
        config: of the simulation.

    Attributes:
        planes: the rectangles.
        middle: (3,), where a camera looks by default, in m.
        room: (2, 3), the smallest and the largest coordinates that a camera may have.

    Raises:
        InputError: the photograph cannot be used.
    """

    def __init__(self, config: TravelConfig) -> None:
        self._kind = _SCENES[config.scene.kind]
        photo = None if config.scene.photo is None else photograph(config.scene.photo)
        self._builder = Builder(config.scene.seed, config.path.centre, config.focal_px)
        self._kind.build(self._builder, photo)
        self.planes: Planes = self._builder.planes()
        self.middle: FloatArray = np.array(self._kind.MIDDLE)
        self.room: FloatArray = np.array(self._kind.ROOM)

    def drawn(self, threads: int) -> Scene:
        """Draw and light the scene, in some threads."""
        return self._builder.scene(self._kind.LIGHTING, threads)


def with_objects(
    scene: Scene,
    objects: tuple[WorldObject, ...],
    pose: FloatArray,
    matrix: FloatArray,
    frame_shape: tuple[int, int],
    mean: float,
) -> Scene:
    """Add what moves on its own.

    Args:
        scene: without it.
        objects: what moves.
        pose: (3, 4) of the first frame, which they face.
        matrix: (3, 3), K.
        frame_shape: (height, width).
        mean: of the light that the scene sends to the camera.
    """
    if not objects:
        return scene
    height, width = frame_shape
    focal, to_world = matrix[0, 0], pose[:, :3].T
    corner, along, down, velocity, textures = [], [], [], [], []
    for each in objects:
        metres = each.distance_m / focal
        size_px = np.array(each.size) * (width, height)
        left, top = np.array(each.at) * (width, height) - 0.5 - size_px / 2
        corner.append(to_world @ (each.distance_m * np.linalg.inv(matrix) @ (left, top, 1) - pose[:, 3]))
        along.append(to_world @ (size_px[0] * metres, 0, 0))
        down.append(to_world @ (0, size_px[1] * metres, 0))
        velocity.append(to_world @ (each.moves_px[0] * metres, each.moves_px[1] * metres, 0))
        textures.append((texture_of(size_px, each.seed) * np.float32(mean * each.flux)).astype(np.float16))
    still = scene.planes
    planes = Planes(
        np.concatenate([still.corner, corner]),
        np.concatenate([still.along, along]),
        np.concatenate([still.down, down]),
        np.concatenate([still.velocity, velocity]),
        np.concatenate([still.is_disc, [each.shape == "disc" for each in objects]]),
    )
    return replace(scene, planes=planes, textures=(*scene.textures, *textures))
