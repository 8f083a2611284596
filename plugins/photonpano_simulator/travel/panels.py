"""Seven textured rectangles at 3 to 7 m, and a background at 10 m, all facing the camera.

Convention:
    Metres; x right, y down, z ahead; the eye is at the origin.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_simulator.street.painter import Painter
from photonpano_simulator.travel.building import Builder
from photonpano_simulator.travel.materials import all_of, boards, books, carpet, cloth, picture, roughen

MIDDLE = (0.0, 0.0, 5.0)
LIGHTING = None
ROOM = ((-10.0, -10.0, -10.0), (10.0, 10.0, 10.0))
"""The smallest and the largest coordinates that a camera may have."""

_DEPTHS = (3.0, 3.6, 4.2, 4.9, 5.6, 6.3, 7.0)
_PLACES = ((-0.95, -0.3), (0.8, 0.5), (-0.1, -0.62), (1.0, -0.5), (-0.7, 0.62), (0.2, 0.15), (-1.2, 0.1))
"""Where the middle of each rectangle is seen, as a tangent, before chance moves it: x from -1.25 to 1.25, y likewise."""
_BACKGROUND_M = 10.0


def build(space: Builder, photo: NDArray[np.float32] | None) -> None:
    """Place the rectangles, whose depths are dealt by chance.

    Args:
        space: receives them.
        photo: linear reflectance for all of them; None draws them.
    """
    ratio = None if photo is None else photo.shape[0] / photo.shape[1]
    wide = 4.4 * _BACKGROUND_M
    tall = wide * (ratio or 1.0)
    space.sheet(
        (-wide / 2, -tall / 2, _BACKGROUND_M), (wide, 0, 0), (0, tall, 0), _background if photo is None else photo, detail=0.7
    )
    drawings = (books, picture, _goods, carpet, _bricks, boards(0.55), cloth(0.7, 120))
    for (right, below), depth, drawing in zip(_PLACES, space.rng.permutation(_DEPTHS), drawings, strict=True):
        width, height = depth * space.rng.uniform(0.24, 0.4, 2)
        height = height if ratio is None else width * ratio
        x = depth * (0.42 * right + float(space.rng.uniform(-0.05, 0.05)))
        y = depth * (0.3 * below + float(space.rng.uniform(-0.05, 0.05)))
        corner = x - width / 2, y - height / 2, depth
        space.sheet(corner, (width, 0, 0), (0, height, 0), drawing if photo is None else photo)


def _background(p: Painter) -> None:
    """Draw a wall of stones of many tones."""
    p.bricks(all_of(p), (900, 420), 0.5, 0.13, 0.2)
    for _ in range(round(p.width * p.height / 2_000_000)):
        x, y, size = p.between(0, p.width), p.between(0, p.height), p.between(40, 320)
        p.ellipse(x, y, (size, size * p.between(0.4, 1)), p.between(0.2, 0.9))
    roughen(p, 0.08)


def _goods(p: Painter) -> None:
    """Draw racks of bottles."""
    p.rectangle(all_of(p), 0.25)
    for shelf in range(3):
        tall = p.height / 3
        for left in np.arange(20.0, p.width - 120, 150):
            size, height, tone = p.between(90, 140), tall * p.between(0.4, 0.85), p.between(0.3, 0.9)
            base = (shelf + 0.92) * tall
            p.rectangle((left, base - 0.65 * height, size, 0.65 * height), tone)
            p.rectangle((left + 0.35 * size, base - height, 0.3 * size, 0.4 * height), tone)
            p.rectangle((left + 6, base - 0.5 * height, size - 12, 0.25 * height), 0.95)
            p.rectangle((left + 16, base - 0.42 * height, size - 40, 0.05 * height), 0.15)
        p.rectangle((0, (shelf + 0.92) * tall, p.width, 0.08 * tall), 0.6)
    roughen(p, 0.04)


def _bricks(p: Painter) -> None:
    """Draw a wall of bricks."""
    p.bricks(all_of(p), (125, 48), 0.5, 0.09, 0.75)
    roughen(p, 0.06)
