"""The street as a whole: sky, skyline, houses, pavement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano_simulator.street.facades import facade, roof, wall
from photonpano_simulator.street.painter import Painter
from photonpano_simulator.street.shops import POSTERS, SHOPS, Shop, front, poster

_HEIGHT = 1365.0
_GROUND = 1130.0
"""Where the houses stand."""
_SHOP_HEIGHT = 290.0
_FLOOR_HEIGHT = 168.0


def street(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Draw a street of shops.

    Args:
        shape: (height, width), px; a wider street has more houses.
        seed: another seed is another street.

    Returns:
        (height, width) tones in [0, 1], encoded as sRGB.
    """
    p = Painter(shape, _HEIGHT, np.random.default_rng(seed))
    sky(p)
    skyline(p)
    shops = p.rng.permutation(len(SHOPS))
    left = -p.between(10, 120)
    pavement(p)
    for corner in houses(p, shops, left):
        lamp(p, corner)
    bunting(p)
    everything = (0.0, 0.0, p.width, p.height)
    p.grain(everything, 0.03, 220)
    p.grain(everything, 0.025, 2)
    return p.finished()


def houses(p: Painter, shops: NDArray[np.int64], left: float) -> list[float]:
    """Draw a row of houses with these shops, from `left` on.

    Returns:
        Where each house ends.
    """
    x, corners = left, list[float]()
    while x < p.width:
        width = p.between(300, 430)
        house(p, x, width, SHOPS[shops[len(corners) % len(SHOPS)]])
        x += width
        corners.append(x)
    return corners


def sky(p: Painter) -> None:
    """Draw clouds: noise of many sizes, flattened."""
    box = (0.0, 0.0, p.width, 700.0)
    p.gradient(box, 0.5, 0.8)
    shape = (700, max(1, round(p.width)))
    clouds = np.zeros(shape, np.float32)
    for octave in range(6):
        clouds += p.noise(shape, 100 / 2**octave) * 0.6**octave
    p.blend(box, 1.0, np.clip(0.2 + 0.5 * clouds, 0, 1))
    p.blend(box, 0.35, np.clip(-0.1 - 0.3 * clouds, 0, 0.5))
    for _ in range(int(0.04 * p.width)):
        bird(p, p.between(0, p.width), p.between(15, 330), p.between(9, 18))


def bird(p: Painter, x: float, y: float, span: float) -> None:
    """Let a gull glide by."""
    tilt, tone = p.between(-0.3, 0.3), 0.12 if p.happens(0.6) else 0.97
    wings = ((-1, -0.35), (-0.45, -0.5), (0, 0), (0.45, -0.5), (1, -0.35))
    p.line([(x + span * a, y + span * (b + tilt * a)) for a, b in wings], tone, 0.22 * span)
    p.ellipse(x, y, (0.22 * span, 0.18 * span), tone)


def skyline(p: Painter) -> None:
    """Draw towers far away."""
    x = -20.0
    while x < p.width:
        width, top, tone = p.between(50, 110), p.between(20, 300), p.between(0.5, 0.68)
        p.gradient((x, top, width, 800 - top), tone, tone * 1.12)
        for row in np.arange(top + 10, 640, 13):
            for column in np.arange(x + 6, x + width - 8, 11):
                p.rectangle((float(column), float(row), 6, 7), tone * (0.72 if p.happens(0.75) else 1.35))
        if p.happens(0.5):
            p.line([(x + width / 2, top), (x + width / 2, top - p.between(15, 60))], tone * 0.7, 2.5)
        x += width + p.between(-14, 30)


def house(p: Painter, x: float, width: float, shop: Shop) -> None:
    """Draw a house from its roof to its shop."""
    floors = int(p.rng.integers(3, 5))
    shop_top = _GROUND - _SHOP_HEIGHT
    top = shop_top - floors * _FLOOR_HEIGHT * p.between(0.94, 1.06)
    roof(p, (x, top - 80, width, 80))
    facade(p, (x, top, width, shop_top - top), floors)
    if width > 390:
        wall(p, (x, shop_top, 96, _SHOP_HEIGHT), "brick", 0.5)
        for row in range(2):
            title, line = POSTERS[int(p.rng.integers(len(POSTERS)))]
            poster(p, (x + 11, shop_top + 20 + 130 * row, 76, 116), title, line)
        x, width = x + 96, width - 96
    front(p, (x, shop_top, width, _SHOP_HEIGHT), shop)
    blade(p, x + width - 70, shop_top - p.between(250, 330), shop.name)


def blade(p: Painter, x: float, y: float, name: str) -> None:
    """Hang a sign whose letters stand on one another."""
    letters = name.split()[0][:9]
    height = 24.0 * len(letters) + 14
    tone = p.between(0.08, 0.3)
    p.shade((x + 5, y + 7, 38, height), 0.55, 0.55)
    p.rectangle((x, y, 38, height), tone)
    p.frame((x + 3, y + 3, 32, height - 6), 0.9, 1.6)
    for index, letter in enumerate(letters):
        p.text(letter, (x + 6, y + 10 + 24 * index, 26, 17), 0.97, 800)


def pavement(p: Painter) -> None:
    """Lay slabs, a kerb, and a cobbled road that comes nearer."""
    p.bricks((0, _GROUND, p.width, 62), (84, 31), 0.6, 0.05, 0.4)
    p.shade((0, _GROUND, p.width, 22), 0.55, 1.0)
    p.bricks((0, _GROUND + 62, p.width, 20), (150, 20), 0.78, 0.04, 0.4)
    y, size = _GROUND + 82, 9.0
    while y < p.height:
        tone = p.between(0.36, 0.42)
        p.bricks((0, y, p.width, size), (2.1 * size * p.between(0.9, 1.1), size), tone, 0.075, 0.16)
        y, size = y + size, size * 1.1
    road = (0.0, _GROUND, p.width, p.height - _GROUND)
    p.grain(road, 0.06, 40)
    p.grain(road, 0.07, 4)
    p.shade((0, _GROUND + 82, p.width, 16), 0.5, 1.0)
    crossing = p.between(0.1, 0.5) * p.width
    for stripe in range(7):
        left, lean = crossing + 66 * stripe, 0.3 * (crossing + 66 * stripe - p.width / 2)
        top, bottom = _GROUND + 88, p.height
        p.polygon([(left, top), (left + 36, top), (left + lean + 48, bottom), (left + lean, bottom)], 0.86)
    for _ in range(int(0.3 * p.width)):
        leaf(p)
    p.grain(road, 0.05, 2.5)


def leaf(p: Painter) -> None:
    """Let a leaf lie, larger the nearer it is."""
    y = p.between(_GROUND + 66, p.height)
    x, size = p.between(0, p.width), 2.2 + 5 * (y - _GROUND) / (p.height - _GROUND)
    angle = p.between(0, np.pi)
    along, across = (
        (size * np.cos(angle), 0.6 * size * np.sin(angle)),
        (-0.45 * size * np.sin(angle), 0.3 * size * np.cos(angle)),
    )
    tips = ((1, 0), (0, 1), (-1, 0), (0, -1))
    points = [(x + a * along[0] + b * across[0], y + a * along[1] + b * across[1]) for a, b in tips]
    p.polygon([(px + 1.5, py + 2) for px, py in points], 0.1)
    p.polygon(points, p.between(0.62, 0.95) if p.happens(0.75) else 0.2)


def lamp(p: Painter, x: float) -> None:
    """Set a lamp post with a bin or a bollard beside it."""
    foot, top = _GROUND + 58, _GROUND - 330
    p.rectangle((x - 3.5, top, 7, foot - top), 0.07)
    p.rectangle((x - 1.5, top, 1.6, foot - top), 0.4)
    p.rectangle((x - 9, foot - 60, 18, 60), 0.07)
    p.polygon([(x - 16, top - 50), (x + 16, top - 50), (x + 9, top), (x - 9, top)], 0.97)
    p.polygon([(x - 21, top - 50), (x + 21, top - 50), (x, top - 74)], 0.07)
    for side in (-12.5, 0, 12.5):
        p.line([(x + side * 1.2, top - 50), (x + side * 0.7, top)], 0.07, 2)
    p.rectangle((x - 34, top + 124, 68, 24), 0.92)
    p.text(p.choice(("PARK", "TRAM 4", "HARBOUR", "OPERA")), (x - 30, top + 130, 60, 12), 0.06, 700)
    p.rectangle((x + 40, foot - 56, 34, 54), 0.22)
    for left in np.arange(x + 43, x + 72, 5):
        p.rectangle((float(left), foot - 48, 2, 40), 0.5)


def bunting(p: Painter) -> None:
    """String pennants from house to house."""
    y, span = p.between(400, 520), 520.0
    for start in np.arange(-p.between(60, 260), p.width, span):
        sag = p.between(40, 80)
        rope = [(float(start) + span * t, y + sag * 4 * t * (1 - t)) for t in np.linspace(0, 1, 27)]
        p.line(rope, 0.1, 1.6)
        for (left, high), (right, low) in zip(rope[:-1:2], rope[1::2], strict=True):
            p.polygon([(left, high), (right, low), ((left + right) / 2, max(high, low) + 24)], p.between(0.1, 1.0))
