"""Shapes, letters and textures on a grey image."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

_OVERSAMPLING = 2
"""Shapes are drawn at twice the resolution and averaged down, which smooths their edges."""
_FRACTION_BITS = 4

Box = tuple[float, float, float, float]
"""x, y, width, height."""


class Painter:
    """Draws with tones from 0, black, to 1, white, as the eye sees them (sRGB).

    Convention:
        Lengths are in units of the drawing, which is `height` units high whatever its size in pixels; x right, y down.

    Args:
        shape: (height, width) of the result, px.
        height: height of the drawing, in units.
        rng: random generator of the drawing.
    """

    def __init__(self, shape: tuple[int, int], height: float, rng: np.random.Generator) -> None:
        self.rng = rng
        self._shape = shape
        self._scale = _OVERSAMPLING * shape[0] / height
        self._image = np.zeros((_OVERSAMPLING * shape[0], _OVERSAMPLING * shape[1]), np.float32)
        self.height = height
        self.width = height * shape[1] / shape[0]

    def finished(self) -> NDArray[np.float32]:
        """Return the image, (height, width) px, tones in [0, 1]."""
        height, width = self._shape
        return np.clip(cv2.resize(self._image, (width, height), interpolation=cv2.INTER_AREA), 0, 1)

    def rectangle(self, box: Box, tone: float) -> None:
        """Fill a rectangle."""
        self._region(box)[:] = tone

    def gradient(self, box: Box, top: float, bottom: float) -> None:
        """Fill a rectangle with a tone that changes from top to bottom."""
        region = self._region(box)
        region[:] = np.linspace(top, bottom, region.shape[0], dtype=np.float32)[:, None]

    def polygon(self, points: Sequence[tuple[float, float]], tone: float) -> None:
        """Fill a polygon."""
        cv2.fillPoly(self._image, [self._fixed(points)], tone, cv2.LINE_8, _FRACTION_BITS)

    def ellipse(self, x: float, y: float, radii: tuple[float, float], tone: float, arc: tuple[float, float] = (0, 360)) -> None:
        """Fill an ellipse around (x, y), or the sector between two angles in degrees, clockwise from the right."""
        (centre,) = self._fixed([(x, y)])
        axes = self._fixed([radii])[0]
        cv2.ellipse(self._image, centre.tolist(), axes.tolist(), 0, *arc, tone, -1, cv2.LINE_8, _FRACTION_BITS)

    def line(self, points: Sequence[tuple[float, float]], tone: float, thickness: float) -> None:
        """Draw a line through points."""
        pixels = max(1, round(thickness * self._scale))
        cv2.polylines(self._image, [self._fixed(points)], False, tone, pixels, cv2.LINE_8, _FRACTION_BITS)

    def frame(self, box: Box, tone: float, thickness: float) -> None:
        """Draw the outline of a rectangle."""
        x, y, width, height = box
        self.line([(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)], tone, thickness)

    def shade(self, box: Box, top: float, bottom: float) -> None:
        """Multiply a rectangle by factors that change from top to bottom: shadows and light."""
        region = self._region(box)
        region *= np.linspace(top, bottom, region.shape[0], dtype=np.float32)[:, None]

    def grain(self, box: Box, amount: float, cell: float) -> None:
        """Roughen a rectangle: multiply it by noise of a standard deviation and a size of its spots."""
        region = self._region(box)
        region *= 1 + amount * self.noise(region.shape, cell)

    def bricks(self, box: Box, brick: tuple[float, float], tone: float, spread: float, joint: float) -> None:
        """Fill a rectangle with courses of bricks, every other one shifted by half a brick.

        `brick` is the width and height of one with its joint; `spread` is the standard deviation of their tones.
        """
        region = self._region(box)
        width, height = (max(3, round(value * self._scale)) for value in brick)
        joint_px = max(1, round(0.7 * self._scale))
        for course, top in enumerate(range(0, region.shape[0], height)):
            tones = tone + spread * self.rng.standard_normal(region.shape[1] // width + 2, dtype=np.float32)
            row = np.repeat(tones, width)
            row.reshape(-1, width)[:, :joint_px] = joint
            start = width // 2 * (course % 2)
            region[top : top + height] = row[start : start + region.shape[1]]
            region[top : top + joint_px] = joint

    def blend(self, box: Box, tone: float, opacity: NDArray[np.float32]) -> None:
        """Lay a tone over a rectangle; the opacity, 0 to 1, is stretched to its size."""
        region = self._region(box)
        if region.size:
            stretched = cv2.resize(opacity, region.shape[::-1], interpolation=cv2.INTER_LINEAR)
            region += (tone - region) * stretched

    def noise(self, shape: tuple[int, ...], cell: float) -> NDArray[np.float32]:
        """Return smooth noise of unit variance, roughly, with spots of `cell` units."""
        step = max(1.0, cell * self._scale)
        rows, columns = (int(np.ceil(size / step)) + 1 for size in shape)
        coarse = self.rng.standard_normal((rows, columns), dtype=np.float32)
        if 0 in shape:
            return np.zeros(shape, np.float32)
        return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC).astype(np.float32, copy=False)

    def text(self, text: str, box: Box, tone: float, weight: int = 500, font: str = "sans") -> None:
        """Write a line in the middle of a box, as large as fits, in "sans" or "italic", from weight 100, thin, to 900."""
        x, y, width, height = (value * self._scale for value in box)
        face = cv2.FontFace(font)
        probe = 100
        _, _, text_width, _ = cv2.getTextSize((0, 0), text, (0, 0), face, probe, weight)
        # Capitals are 0.7 of the font's size.
        size = int(min(height / 0.7, width * probe / max(1, text_width)))
        if size < 6:
            return
        left = x + (width - text_width * size / probe) / 2
        baseline = y + (height + 0.7 * size) / 2
        top, margin = int(baseline - size), int(0.4 * size)
        rows = slice(max(0, top), max(0, min(self._image.shape[0], int(baseline) + margin)))
        columns = slice(max(0, int(left) - margin), max(0, min(self._image.shape[1], int(x + width) + margin)))
        region = self._image[rows, columns]
        if region.size == 0:
            return
        mask = np.zeros(region.shape, np.uint8)
        cv2.putText(mask, text, (int(left) - columns.start, int(baseline) - rows.start), 255, face, size, weight)
        region += (tone - region) * (mask / np.float32(255))

    def choice(self, items: Sequence[str]) -> str:
        """Pick one."""
        return items[int(self.rng.integers(len(items)))]

    def between(self, low: float, high: float) -> float:
        """Pick a number."""
        return float(self.rng.uniform(low, high))

    def happens(self, chance: float) -> bool:
        """Toss a coin."""
        return bool(self.rng.random() < chance)

    def _region(self, box: Box) -> NDArray[np.float32]:
        x, y, width, height = box
        rows = slice(*(max(0, round(value * self._scale)) for value in (y, y + height)))
        columns = slice(*(max(0, round(value * self._scale)) for value in (x, x + width)))
        return self._image[rows, columns]

    def _fixed(self, points: Iterable[tuple[float, float]]) -> NDArray[np.int32]:
        """Return OpenCV's fixed-point pixels."""
        fixed: NDArray[np.int32] = np.round(np.asarray(list(points)) * (self._scale * 2**_FRACTION_BITS)).astype(np.int32)
        return fixed
