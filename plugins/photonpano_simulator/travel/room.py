"""A furnished room.

Convention:
    Metres; x right, y down, z ahead; the eye is at the origin, 1.5 m above the floor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_simulator.street.painter import Painter
from photonpano_simulator.travel.building import Builder, Drawing
from photonpano_simulator.travel.lighting import Lighting
from photonpano_simulator.travel.materials import (
    boards,
    books,
    carpet,
    cloth,
    door,
    drawers,
    parcel,
    picture,
    plaster,
    wallpaper,
    wood,
)

FLOOR, CEILING = 1.5, -1.1
LEFT, RIGHT, BACK, FRONT = -2.5, 2.5, -1.8, 4.2
MIDDLE = (0.0, 0.45, 3.2)
LIGHTING = Lighting(lamps=((0.3, -0.55, 2.2, 0.15, 1.1), (-1.6, 0.1, 3.6, 0.08, 0.35)), ambient=0.45, shadow_m=0.9)
ROOM = ((LEFT, CEILING, BACK), (RIGHT, FLOOR, FRONT))
"""The smallest and the largest coordinates that a camera may have."""


def build(room: Builder, photo: NDArray[np.float32] | None) -> None:
    """Place a room: walls, and furniture whose places and drawings depend on the seed.

    Args:
        room: receives it.
        photo: linear reflectance, for the pictures on the walls; None draws them.
    """
    _walls(room)
    _pictures(room, photo if photo is not None else picture)
    _shelf(room)
    _table(room)
    _chair(room, (0.55 + _off(room, 0.2), FLOOR, 1.75), 200 + _off(room, 25))
    _sofa(room)
    _chest(room)
    _floor_things(room)
    _lamps(room)


def _off(room: Builder, reach: float) -> float:
    """Return a number by chance between -reach and reach."""
    return float(room.rng.uniform(-reach, reach))


def _walls(room: Builder) -> None:
    width, height, depth = RIGHT - LEFT, FLOOR - CEILING, FRONT - BACK
    side = wallpaper(float(room.rng.uniform(0.6, 0.75))) if room.rng.random() < 0.6 else plaster(0.75)
    room.sheet((LEFT, CEILING, FRONT), (width, 0, 0), (0, height, 0), side)
    room.sheet((RIGHT, CEILING, BACK), (-width, 0, 0), (0, height, 0), plaster(0.7))
    room.sheet((LEFT, CEILING, BACK), (0, 0, depth), (0, height, 0), plaster(0.72), detail=0.7)
    room.sheet((RIGHT, CEILING, FRONT), (0, 0, -depth), (0, height, 0), plaster(0.66), detail=0.7)
    room.sheet((LEFT, FLOOR, FRONT), (width, 0, 0), (0, 0, -depth), boards(0.5), detail=0.6)
    room.sheet((LEFT, CEILING, BACK), (width, 0, 0), (0, 0, depth), plaster(0.9), detail=0.4)
    for corner, along in (
        ((LEFT, FLOOR - 0.1, FRONT - 0.015), (width, 0, 0)),
        ((LEFT + 0.015, FLOOR - 0.1, BACK), (0, 0, depth)),
    ):
        room.sheet(corner, along, (0, 0.1, 0), wood(0.75))
    room.sheet((RIGHT - 0.015, FLOOR - 0.1, FRONT), (0, 0, -depth), (0, 0.1, 0), wood(0.75))
    x = _off(room, 0.4) + 0.75
    room.sheet((x, -0.75, FRONT - 0.03), (1.15, 0, 0), (0, 1.25, 0), _window, glow=0.5)
    room.sheet((RIGHT - 0.02, FLOOR - 2.05, 1.5), (0, 0, -0.9), (0, 2.05, 0), door)


def _window(p: Painter) -> None:
    """Draw a window with trees outside."""
    p.rectangle((0, 0, p.width, p.height), 0.62)
    x, y, width, height = inside = 70.0, 70.0, p.width - 140, p.height - 170
    p.gradient(inside, 0.98, 0.8)
    for _ in range(700):
        low = 1 - p.between(0, 1) ** 1.5 * 0.62
        tone, size = p.between(0.25, 0.6) * (1.35 - 0.5 * low), p.between(8, 26)
        p.ellipse(x + p.between(0, 1) * width, min(y + low * height, y + height - size), (size, 0.8 * size), tone)
    for share in (0.0, 0.5, 1.0):
        p.rectangle((x + share * (width - 50), y, 50, height), 0.7)
        p.rectangle((x + share * (width - 50), y, 6, height), 0.4)
    for share in (0.0, 0.36, 1.0):
        p.rectangle((x, y + share * (height - 45), width, 45), 0.72)
        p.rectangle((x, y + share * (height - 45) + 39, width, 6), 0.4)
    p.rectangle((0, p.height - 90, p.width, 90), 0.8)
    p.shade((0, p.height - 40, p.width, 40), 0.8, 0.6)


def _pictures(room: Builder, draw: Drawing | NDArray[np.float32]) -> None:
    ratio = draw.shape[0] / draw.shape[1] if isinstance(draw, np.ndarray) else None
    for x in (-1.15, -0.35):
        width = float(room.rng.uniform(0.45, 0.65))
        height = width * (ratio or float(room.rng.uniform(0.8, 1.35)))
        room.sheet((x + _off(room, 0.05) - width / 2, -0.3 - height / 2, FRONT - 0.03), (width, 0, 0), (0, height, 0), draw)
    for z in (1.2, 2.3, 3.3):
        width = float(room.rng.uniform(0.5, 0.75))
        height = width * (ratio or float(room.rng.uniform(0.7, 1.2)))
        room.sheet((LEFT + 0.03, -0.25 - height / 2, z - width / 2), (0, 0, width), (0, height, 0), draw)
    for z in (3.5, 2.4):
        width = float(room.rng.uniform(0.5, 0.8))
        height = width * (ratio or float(room.rng.uniform(0.7, 1.2)))
        room.sheet((RIGHT - 0.03, -0.3 - height / 2, z + width / 2), (0, 0, -width), (0, height, 0), draw)


def _shelf(room: Builder) -> None:
    """Stand a bookcase against the front wall, and things on it."""
    width, height, depth = float(room.rng.uniform(0.9, 1.2)), float(room.rng.uniform(1.0, 1.2)), 0.32
    x, z = -0.95 + _off(room, 0.15), FRONT - 0.04 - depth / 2
    room.box((x, FLOOR, z), (width, height, depth), wood(0.42), front=books, top=wood(0.45))
    for place in (-0.3, 0.05, 0.32):
        size = float(room.rng.uniform(0.12, 0.22))
        room.box((x + place * width, FLOOR - height, z), (size, size * 1.1, 0.18), parcel, yaw_deg=_off(room, 30))


def _table(room: Builder) -> None:
    """Lay a table."""
    x, z, width, depth, height = 0.35 + _off(room, 0.15), 2.55 + _off(room, 0.1), 1.35, 0.75, 0.74
    tone = float(room.rng.uniform(0.4, 0.62))
    room.box((x, FLOOR - height + 0.04, z), (width, 0.04, depth), wood(tone))
    room.box((x, FLOOR - height + 0.12, z), (width - 0.12, 0.08, depth - 0.12), wood(tone * 0.85))
    for side in (-1, 1):
        for end in (-1, 1):
            room.box(
                (x + side * (width / 2 - 0.07), FLOOR, z + end * (depth / 2 - 0.07)),
                (0.06, height - 0.12, 0.06),
                wood(tone * 0.8),
            )
    runner = 0.36
    room.sheet((x - width / 2 - 0.0, FLOOR - height - 0.003, z + runner / 2), (width, 0, 0), (0, 0, -runner), cloth(0.7))
    for place in (-0.42, -0.12, 0.2, 0.46):
        size = float(room.rng.uniform(0.12, 0.26))
        base = x + place * width * 0.9, FLOOR - height - 0.004, z + _off(room, 0.18)
        material = parcel if room.rng.random() < 0.6 else cloth(0.65, 40)
        room.box(base, (size, size * float(room.rng.uniform(0.6, 1.3)), size * 0.8), material, yaw_deg=_off(room, 40))


def _chair(room: Builder, base: tuple[float, float, float], yaw_deg: float) -> None:
    x, y, z = base
    tone, size = float(room.rng.uniform(0.3, 0.55)), 0.42
    turn = np.deg2rad(yaw_deg)
    for side in (-1, 1):
        for end in (-1, 1):
            dx, dz = side * (size / 2 - 0.03), end * (size / 2 - 0.03)
            place = x + dx * np.cos(turn) + dz * np.sin(turn), y, z - dx * np.sin(turn) + dz * np.cos(turn)
            tall = 0.9 if end > 0 else 0.43
            room.box((float(place[0]), y, float(place[2])), (0.045, tall, 0.045), wood(tone), yaw_deg=yaw_deg)
    room.box((x, y - 0.43, z), (size, 0.045, size), cloth(0.6, 70), yaw_deg=yaw_deg)
    reach = size / 2 - 0.03
    back = x + reach * np.sin(turn), y - 0.68, z + reach * np.cos(turn)
    room.box((float(back[0]), float(back[1]), float(back[2])), (size - 0.08, 0.2, 0.03), wood(tone * 1.15), yaw_deg=yaw_deg)


def _sofa(room: Builder) -> None:
    """Stand a sofa at the left wall, facing right."""
    z, tone = 2.5 + _off(room, 0.2), float(room.rng.uniform(0.35, 0.65))
    cover, x = cloth(tone, 110), LEFT + 0.5
    room.box((x, FLOOR, z), (0.85, 0.42, 1.5), cover)
    room.box((LEFT + 0.2, FLOOR - 0.42, z), (0.24, 0.4, 1.5), cover)
    for end in (-1, 1):
        room.box((x, FLOOR, z + end * 0.83), (0.85, 0.6, 0.16), cover)
    for place in (-0.42, 0.3):
        room.box(
            (LEFT + 0.45, FLOOR - 0.42, z + place),
            (0.14, 0.38, 0.4),
            cloth(float(room.rng.uniform(0.3, 0.9)), 36),
            yaw_deg=_off(room, 12),
        )


def _chest(room: Builder) -> None:
    """Stand a chest of drawers at the right wall, and things on it."""
    z, height = 3.2 + _off(room, 0.2), float(room.rng.uniform(0.85, 1.0))
    room.box((RIGHT - 0.27, FLOOR, z), (1.1, height, 0.48), wood(0.45), front=drawers, yaw_deg=90)
    for place in (-0.3, 0.0, 0.3):
        size = float(room.rng.uniform(0.14, 0.28))
        room.box((RIGHT - 0.28, FLOOR - height, z + place), (size, size * 1.2, size), parcel, yaw_deg=_off(room, 45))


def _floor_things(room: Builder) -> None:
    room.sheet((-1.1, FLOOR - 0.008, 3.3), (2.3, 0, 0), (0, 0, -1.7), carpet, detail=0.8)
    for x, z in ((-0.75, 2.0), (1.45, 1.9), (1.65, 3.6)):
        size = float(room.rng.uniform(0.25, 0.42))
        room.box(
            (x + _off(room, 0.15), FLOOR - 0.01, z + _off(room, 0.15)), (size, size * 0.9, size), parcel, yaw_deg=_off(room, 45)
        )


def _lamps(room: Builder) -> None:
    """Hang a lamp over the table, and stand one in the corner."""
    room.box((0.3, -0.62, 2.2), (0.34, 0.16, 0.34), cloth(0.85, 34), yaw_deg=20)
    room.box((0.3, -0.78, 2.2), (0.015, 0.32, 0.015), wood(0.2))
    room.box((-1.6, FLOOR, 3.75), (0.03, 1.15, 0.03), wood(0.2))
    room.box((-1.6, FLOOR - 1.15 - 0.02, 3.75), (0.26, 0.26, 0.26), cloth(0.9, 30), yaw_deg=30)
