"""Build scenes of textured rectangles: boxes, boards and pictures, drawn when all of them are placed, and lit.

Convention:
    Metres; x right, y down, z ahead. A rectangle is seen from the side on which `along` points to the right and `down` down.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from photonpano import FloatArray
from photonpano.photometry import srgb_to_linear
from photonpano_simulator.sensor import Draw, generator
from photonpano_simulator.street.painter import Painter
from photonpano_simulator.travel.lighting import Lighting, light_on
from photonpano_simulator.travel.planes import Planes

Drawing = Callable[[Painter], None]
"""Draws on a painter whose units are millimetres, unless a sheet has others."""

_NEAREST_M = 0.6
"""Textures are as fine as pixels at the distance of their plane, but not finer than pixels at this distance."""
_MOST_TEXELS = 24_000_000
"""Texels of a scene: beyond, all textures are coarser. They take 2 bytes each in the truth."""
_DARKEST = 0.004
"""Reflectance below which nothing is painted, so that every place gives some light."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Planes with their textures.

    Attributes:
        planes: the rectangles.
        textures: the light that each sends to the camera, up to a factor: (height, width) float16 each.
    """

    planes: Planes
    textures: tuple[NDArray[np.float16], ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Sheet:
    """A rectangle that is to be drawn."""

    corner: FloatArray
    along: FloatArray
    down: FloatArray
    draw: Drawing | NDArray[np.float32]
    units: float
    detail: float
    glow: float

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in m."""
        return float(np.linalg.norm(self.along)), float(np.linalg.norm(self.down))


class Builder:
    """Collects rectangles, then draws and lights them.

    Args:
        seed: of the drawings: each has a random generator of its own.
        eye: (3,), where the camera is, in m: textures are as fine as it sees them.
        focal_px: focal length of the camera.
    """

    def __init__(self, seed: int, eye: ArrayLike, focal_px: float) -> None:
        self.rng = generator(seed, Draw.SCENE)
        self._seed, self._eye, self._focal_px = seed, np.asarray(eye, np.float64), focal_px
        self._sheets: list[_Sheet] = []

    def sheet(
        self,
        corner: ArrayLike,
        along: ArrayLike,
        down: ArrayLike,
        draw: Drawing | NDArray[np.float32],
        *,
        units: float = 1000.0,
        detail: float = 1.0,
        glow: float = 0.0,
    ) -> None:
        """Place a rectangle.

        Args:
            corner: (3,), top left, in m.
            along: (3,), from there to the top right.
            down: (3,), from there to the bottom left.
            draw: the drawing, or an image of linear reflectance.
            units: units of the drawing in a metre.
            detail: texels along a pixel of the camera.
            glow: light that it sends by itself, relative to its reflectance in full light.
        """
        begin, right, below = (np.asarray(each, np.float64) for each in (corner, along, down))
        self._sheets.append(_Sheet(begin, right, below, draw, units, detail, glow))

    def box(
        self,
        base: tuple[float, float, float],
        size: tuple[float, float, float],
        draw: Drawing,
        *,
        front: Drawing | None = None,
        top: Drawing | None = None,
        yaw_deg: float = 0.0,
        detail: float = 1.0,
    ) -> None:
        """Place a box without a bottom.

        Args:
            base: (x, y, z) of the middle of its base.
            size: width, height and depth.
            draw: drawing of its sides.
            front: drawing of the side to the camera; by default as the others.
            top: drawing of its top; by default as its sides.
            yaw_deg: its turn about the vertical, to the right.
            detail: see `sheet`.
        """
        width, height, depth = size
        cos, sin = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
        right, ahead = np.array([cos, 0, -sin]), np.array([sin, 0, cos])
        down = np.array([0.0, height, 0.0])
        upper = np.asarray(base) - down
        left_near = upper - right * width / 2 - ahead * depth / 2
        right_far = upper + right * width / 2 + ahead * depth / 2
        self.sheet(left_near, right * width, down, front or draw, detail=detail)
        self.sheet(right_far, -right * width, down, draw, detail=detail)
        self.sheet(left_near + ahead * depth, -ahead * depth, down, draw, detail=detail)
        self.sheet(right_far - ahead * depth, ahead * depth, down, draw, detail=detail)
        self.sheet(left_near + ahead * depth, right * width, -ahead * depth, top or draw, detail=detail)

    def planes(self) -> Planes:
        """Return the rectangles."""
        corner, along, down = (np.stack([getattr(each, name) for each in self._sheets]) for name in ("corner", "along", "down"))
        return Planes(corner, along, down, np.zeros_like(corner), np.zeros(len(corner), bool))

    def scene(self, lighting: Lighting | None, threads: int) -> Scene:
        """Draw and light all rectangles.

        Args:
            lighting: of the scene; None lights all places alike.
            threads: that draw.
        """
        planes = self.planes()
        texels = np.array([self._texel(each) for each in self._sheets])
        areas = np.array([np.prod(each.size) for each in self._sheets])
        texels *= max(1.0, float((areas / texels**2).sum() / _MOST_TEXELS) ** 0.5)

        def texture(index: int) -> NDArray[np.float16]:
            sheet = self._sheets[index]
            light = np.ones((1, 1), np.float32) if lighting is None else light_on(planes, index, lighting)
            return _lit(self._drawn(sheet, index, float(texels[index])), light, sheet.glow)

        with ThreadPoolExecutor(max(1, threads)) as pool:
            return Scene(planes, tuple(pool.map(texture, range(len(self._sheets)))))

    def _texel(self, sheet: _Sheet) -> float:
        """Return the size of the texels of a sheet, in m."""
        axes = np.stack([sheet.along, sheet.down])
        places = np.clip(axes @ (self._eye - sheet.corner) / (axes**2).sum(axis=1), 0, 1)
        distance = float(np.linalg.norm(sheet.corner + places @ axes - self._eye))
        return max(distance, _NEAREST_M) / (self._focal_px * sheet.detail)

    def _drawn(self, sheet: _Sheet, index: int, texel: float) -> NDArray[np.float32]:
        """Return the linear reflectance of a sheet."""
        width, height = sheet.size
        shape = max(2, round(height / texel)), max(2, round(width / texel))
        if isinstance(sheet.draw, np.ndarray):
            if shape[0] >= sheet.draw.shape[0]:
                return sheet.draw
            return np.asarray(cv2.resize(sheet.draw, shape[::-1], interpolation=cv2.INTER_AREA), np.float32)
        painter = Painter(shape, height * sheet.units, generator(self._seed, Draw.TEXTURE, index))
        sheet.draw(painter)
        return srgb_to_linear(painter.finished())


def _lit(reflectance: NDArray[np.float32], light: NDArray[np.float32], glow: float) -> NDArray[np.float16]:
    """Return the light that a texture sends out, rounded as the truth keeps it."""
    height, width = reflectance.shape
    smooth = np.asarray(cv2.resize(light, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    texture: NDArray[np.float16] = (np.maximum(reflectance, _DARKEST) * (smooth + np.float32(glow))).astype(np.float16)
    return texture
