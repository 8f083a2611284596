"""A street of shops, seen from across the street, with poles, benches, a kiosk and signs before it.

Convention:
    Metres; x right, y down, z ahead; the eye is at the origin, 1.5 m above the ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_simulator.street.facades import wall
from photonpano_simulator.street.painter import Painter
from photonpano_simulator.street.scene import houses, sky, skyline
from photonpano_simulator.street.shops import POSTERS, SHOPS, front, menu, poster
from photonpano_simulator.travel.building import Builder, Drawing
from photonpano_simulator.travel.lighting import Lighting
from photonpano_simulator.travel.materials import all_of, parcel, roughen, wood

GROUND, HOUSES = 1.5, 8.0
MIDDLE = (0.0, 0.1, 8.0)
LIGHTING = Lighting(lamps=((-30.0, -45.0, -35.0, 1.5, 0.75),), ambient=0.45, shadow_m=2.5, reach_m=64.0)
ROOM = ((-12.0, -15.0, -0.9), (12.0, GROUND, HOUSES))
"""The smallest and the largest coordinates that a camera may have."""

_STREET_UNITS = 56.0
"""Units of the drawn street in a metre: a floor is 168 units high."""
_GROUND_UNITS = 1130.0
"""Height of the drawn street above its ground, in its units."""
_HALF_WIDTH = 15.0


def build(street: Builder, photo: NDArray[np.float32] | None) -> None:
    """Place a street: its houses, the ground, and things at several depths, whose places depend on the seed.

    Args:
        street: receives it.
        photo: linear reflectance, for the houses; None draws them.
    """
    height = _GROUND_UNITS / _STREET_UNITS
    width = 2 * _HALF_WIDTH if photo is None else height * photo.shape[1] / photo.shape[0]
    left = -width / 2
    street.sheet(
        (left, GROUND - height, HOUSES), (width, 0, 0), (0, height, 0), _houses if photo is None else photo, units=_STREET_UNITS
    )
    street.sheet((-_HALF_WIDTH, GROUND, HOUSES), (2 * _HALF_WIDTH, 0, 0), (0, 0, -HOUSES - 1), _slabs, detail=0.5)
    _kiosk(street)
    for x, z in ((-2.9, 5.2), (3.3, 6.6)):
        _bench(street, x + _off(street, 0.4), z + _off(street, 0.3))
    for x, z in ((-1.35, 3.6), (1.9, 4.6), (-4.2, 6.4), (5.0, 5.6), (0.35, 7.2)):
        _pole(street, x + _off(street, 0.25), z + _off(street, 0.2))
    for x, z in ((0.25, 4.9), (-1.9, 6.9), (3.9, 4.2)):
        _board(street, x + _off(street, 0.3), z + _off(street, 0.2))
    for x in np.arange(-7.5, 8, 1.25):
        street.box((float(x), GROUND, 6.05), (0.09, 0.75, 0.09), _iron)
    for x, z in ((-0.6, 5.7), (2.75, 5.3), (-3.9, 4.4)):
        size = float(street.rng.uniform(0.4, 0.6))
        street.box((x + _off(street, 0.2), GROUND, z), (1.6 * size, size, size), _planter, yaw_deg=_off(street, 10))
    _column(street, 5.9 + _off(street, 0.4), 6.7)


def _off(street: Builder, reach: float) -> float:
    """Return a number by chance between -reach and reach."""
    return float(street.rng.uniform(-reach, reach))


def _houses(p: Painter) -> None:
    """Draw the row of houses under the sky, down to the ground."""
    sky(p)
    skyline(p)
    houses(p, p.rng.permutation(len(SHOPS)), -p.between(10, 120))
    p.grain(all_of(p), 0.03, 220)
    p.grain(all_of(p), 0.025, 2)


def _slabs(p: Painter) -> None:
    """Pave the ground with slabs, joints and stains."""
    p.bricks(all_of(p), (620, 410), 0.6, 0.06, 0.36)
    for _ in range(round(p.width * p.height / 300_000)):
        x, y, size = p.between(0, p.width), p.between(0, p.height), p.between(6, 40)
        p.ellipse(x, y, (size, 0.7 * size), p.between(0.25, 0.75))
    roughen(p, 0.06)


def _iron(p: Painter) -> None:
    """Paint iron, worn at its edges, with stickers."""
    p.rectangle(all_of(p), 0.22)
    p.rectangle((0.12 * p.width, 0, 0.1 * p.width, p.height), 0.55)
    for _ in range(round(p.height / 160)):
        y = p.between(0, p.height)
        p.rectangle((0.1 * p.width, y, 0.8 * p.width, p.between(25, 60)), p.between(0.3, 0.95))
    roughen(p, 0.05)


def _planter(p: Painter) -> None:
    """Draw a box of plants."""
    p.rectangle(all_of(p), 0.45)
    for top in np.arange(0.3 * p.height, p.height, 60):
        p.rectangle((0, float(top), p.width, 5), 0.2)
    for _ in range(round(p.width * 0.5)):
        tone = p.between(0.08, 0.4) if p.happens(0.75) else p.between(0.7, 1.0)
        p.ellipse(p.between(0, p.width), p.between(0, 0.4 * p.height), (p.between(6, 24), p.between(6, 18)), tone)
    roughen(p, 0.05)


def _kiosk(street: Builder) -> None:
    """Set up a kiosk: a shop of its own, under a flat roof."""
    x, z, width, height = 1.0 + _off(street, 0.3), 6.4, 1.9, 2.45
    shop = SHOPS[int(street.rng.integers(len(SHOPS)))]

    def shop_front(p: Painter) -> None:
        # Shops are drawn 290 units high.
        front(p, (0, 0, p.width, p.height), shop)

    left, near = x - width / 2, z - 0.65
    street.sheet((left, GROUND - height, near), (width, 0, 0), (0, height, 0), shop_front, units=290 / height)
    for corner, along in (
        ((left, GROUND - height, near + 1.3), (0, 0, -1.3)),
        ((left + width, GROUND - height, near), (0, 0, 1.3)),
    ):
        street.sheet(corner, along, (0, height, 0), _posters, units=150)
    street.box((x, GROUND - height, z - 0.1), (width + 0.3, 0.12, 1.7), wood(0.35))


def _posters(p: Painter) -> None:
    """Cover a wall with posters, 150 units a metre."""
    wall(p, all_of(p), "boards", 0.5)
    for row in range(max(1, int(p.height // 120))):
        for column in range(max(1, int(p.width // 84))):
            title, line = POSTERS[int(p.rng.integers(len(POSTERS)))]
            poster(p, (6 + 84 * column, 8 + 120 * row, 76, 108), title, line)


def _column(street: Builder, x: float, z: float) -> None:
    """Set up an advertising column."""
    street.box((x, GROUND, z), (0.9, 2.6, 0.9), lambda p: _scaled_posters(p), yaw_deg=35)


def _scaled_posters(p: Painter) -> None:
    """Cover the side of a column with posters."""
    p.rectangle(all_of(p), 0.4)
    for row in range(3):
        title, line = POSTERS[int(p.rng.integers(len(POSTERS)))]
        poster(p, (30, 40 + row * p.height / 3, p.width - 60, p.height / 3 - 60), title, line)
    roughen(p, 0.03)


def _bench(street: Builder, x: float, z: float) -> None:
    """Place a bench of slats."""
    tone, width = float(street.rng.uniform(0.4, 0.6)), 1.5
    for k in range(3):
        street.box((x, GROUND - 0.42, z - 0.16 + 0.15 * k), (width, 0.035, 0.11), wood(tone))
        street.box((x, GROUND - 0.5 - 0.15 * k, z + 0.24), (width, 0.11, 0.03), wood(tone * 1.1))
    for side in (-0.6, 0.6):
        street.box((x + side, GROUND, z), (0.06, 0.42, 0.4), _iron)
        street.box((x + side, GROUND, z + 0.28), (0.05, 0.92, 0.04), _iron)


def _pole(street: Builder, x: float, z: float) -> None:
    """Set up a pole with a traffic sign."""
    street.box((x, GROUND, z), (0.08, 3.6, 0.08), _iron, yaw_deg=_off(street, 40))
    width, height = float(street.rng.uniform(0.45, 0.7)), float(street.rng.uniform(0.3, 0.6))
    top = -0.75 + _off(street, 0.3)
    street.sheet((x - width / 2, top, z - 0.06), (width, 0, 0), (0, height, 0), _sign(int(street.rng.integers(6))))


def _sign(which: int) -> Drawing:
    """Return a street sign."""
    title = ("PARK", "TRAM 4", "HARBOUR", "OPERA", "ONE WAY", "MUSEUM")[which]

    def draw(p: Painter) -> None:
        board, ink = ((0.93, 0.06), (0.12, 0.95))[which % 2]
        p.rectangle(all_of(p), board)
        p.frame((14, 14, p.width - 28, p.height - 28), ink, 9)
        p.text(title, (35, 0.14 * p.height, p.width - 70, 0.36 * p.height), ink, 800)
        middle = 0.72 * p.height
        p.rectangle((0.2 * p.width, middle - 14, 0.45 * p.width, 28), ink)
        p.polygon([(0.62 * p.width, middle - 50), (0.8 * p.width, middle), (0.62 * p.width, middle + 50)], ink)
        roughen(p, 0.03)

    return draw


def _board(street: Builder, x: float, z: float) -> None:
    """Put up a board with a menu."""
    shop = next(shop for shop in SHOPS[int(street.rng.integers(5)) :] + SHOPS if shop.menu)
    lean = 0.2

    def draw(p: Painter) -> None:
        p.rectangle(all_of(p), 0.5)
        menu(p, (8, 8, p.width - 16, p.height - 16), shop.menu)

    street.sheet((x - 0.35, GROUND - 1.0, z), (0.7, 0, 0), (0, 1.0, -lean), draw, units=130)
    street.box((x + 0.6, GROUND, z + 0.2), (0.34, 0.3, 0.34), parcel, yaw_deg=_off(street, 40))
