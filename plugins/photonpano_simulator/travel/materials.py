"""What planes are made of: drawings of wood, cloth, plaster, books and pictures, in units of mm."""

from __future__ import annotations

import numpy as np

from photonpano_simulator.street.painter import Painter
from photonpano_simulator.street.shops import POSTERS, poster
from photonpano_simulator.travel.building import Drawing


def all_of(p: Painter) -> tuple[float, float, float, float]:
    """Return the box that covers all of a drawing."""
    return 0.0, 0.0, p.width, p.height


def roughen(p: Painter, amount: float) -> None:
    """Roughen a drawing with noise of all sizes, from 3 mm to half a metre."""
    for cell, share in ((450, 1.0), (150, 0.9), (50, 0.8), (16, 0.7), (6, 0.6), (3, 0.5)):
        p.grain(all_of(p), amount * share, cell)


def plaster(tone: float) -> Drawing:
    """Return a plastered wall with stains, scratches and holes of nails."""

    def draw(p: Painter) -> None:
        p.rectangle(all_of(p), tone)
        roughen(p, 0.045)
        for _ in range(round(p.width * p.height / 60_000)):
            x, y, size = p.between(0, p.width), p.between(0, p.height), p.between(2, 9)
            p.ellipse(x, y, (size, size * p.between(0.5, 1)), tone * p.between(0.45, 1.3))
        for _ in range(round(p.width * p.height / 250_000)):
            x, y = p.between(0, p.width), p.between(0, p.height)
            p.line([(x, y), (x + p.between(-90, 90), y + p.between(-40, 40))], tone * p.between(0.6, 0.85), p.between(2, 5))

    return draw


def wallpaper(tone: float) -> Drawing:
    """Return a wallpaper of stripes with a pattern of leaves."""

    def draw(p: Painter) -> None:
        p.rectangle(all_of(p), tone)
        for stripe, x in enumerate(np.arange(0, p.width, 110)):
            p.rectangle((float(x), 0, 55, p.height), tone * 0.86)
            for y in np.arange(60 * (stripe % 2), p.height, 120):
                for side in (-1, 1):
                    middle = float(x) + 82, float(y) + 40
                    tip, bulge = side * p.between(18, 24), p.between(6, 9)
                    leaf = ((0, 24), (0.6 * tip, 8 - bulge), (tip, -18), (0.25 * tip, -2))
                    p.polygon([(middle[0] + dx, middle[1] + dy) for dx, dy in leaf], tone * p.between(0.5, 0.66))
                p.ellipse(float(x) + 27, float(y) + 95, (7, 7), tone * 1.2)
        roughen(p, 0.03)

    return draw


def boards(tone: float, width: float = 140.0) -> Drawing:
    """Return boards of wood, side by side along the x axis of the drawing."""

    def draw(p: Painter) -> None:
        for y in np.arange(0, p.height, width):
            x = -p.between(0, 1500)
            while x < p.width:
                length, shade = p.between(900, 2200), tone * p.between(0.72, 1.25)
                p.rectangle((x, float(y), length, width), shade)
                for _ in range(round(width / 5)):
                    grain_y = float(y) + p.between(3, width - 3)
                    start, sway = x + p.between(0, length), p.between(-6, 6)
                    line = [(start, grain_y), (start + 150, grain_y + sway), (start + p.between(200, 500), grain_y)]
                    p.line(line, shade * p.between(0.7, 0.95), p.between(1.5, 3.5))
                if p.happens(0.4):
                    p.ellipse(x + p.between(0, length), float(y) + width / 2, (14, 8), shade * 0.55)
                p.rectangle((x, float(y), 4, width), tone * 0.35)
                x += length
            p.rectangle((0, float(y), p.width, 4), tone * 0.35)
        roughen(p, 0.035)

    return draw


def wood(tone: float) -> Drawing:
    """Return one piece of wood, with an edge."""

    def draw(p: Painter) -> None:
        p.rectangle(all_of(p), tone)
        for _ in range(round(p.height / 7) + 2):
            y, sway = p.between(0, p.height), p.between(-9, 9)
            start = p.between(-200, p.width)
            line = [(start, y), (start + 120, y + sway), (start + p.between(200, 600), y - sway)]
            p.line(line, tone * p.between(0.7, 0.93), p.between(1.5, 5))
        roughen(p, 0.04)
        p.frame((4, 4, p.width - 8, p.height - 8), tone * 0.7, 8)

    return draw


def cloth(tone: float, check: float = 60.0) -> Drawing:
    """Return a checked cloth."""

    def draw(p: Painter) -> None:
        p.rectangle(all_of(p), tone)
        for x in np.arange(0, p.width, check):
            p.shade((float(x), 0, check * 0.5, p.height), 0.74, 0.74)
            p.rectangle((float(x) + 0.7 * check, 0, 0.06 * check, p.height), min(1, tone * 1.5))
        for y in np.arange(0, p.height, check):
            p.shade((0, float(y), p.width, check * 0.5), 0.74, 0.74)
            p.shade((0, float(y) + 0.7 * check, p.width, 0.06 * check), 1.4, 1.4)
        roughen(p, 0.05)

    return draw


def carpet(p: Painter) -> None:
    """Draw a carpet with borders and rows of diamonds."""
    dark, light = p.between(0.15, 0.3), p.between(0.65, 0.85)
    p.rectangle(all_of(p), dark)
    for inset, tone in ((60, light), (110, dark * 1.6), (190, light * 0.8), (220, dark)):
        p.rectangle((inset, inset, p.width - 2 * inset, p.height - 2 * inset), tone)
    for row, y in enumerate(np.arange(320, p.height - 280, 150)):
        for x in np.arange(320 + 75 * (row % 2), p.width - 280, 150):
            for size, tone in ((66, light), (44, 2 * dark), (20, light)):
                p.polygon([(x, y - size), (x + 0.7 * size, y), (x, y + size), (x - 0.7 * size, y)], tone * p.between(0.85, 1.1))
    roughen(p, 0.05)


def books(p: Painter) -> None:
    """Draw shelves of books."""
    p.rectangle(all_of(p), 0.1)
    count = max(1, round(p.height / 340))
    pitch = (p.height - 40) / count
    for shelf in range(count):
        top = 20 + shelf * pitch
        # Spines of books are 6 to 13 units wide in the street: 20 to 45 mm here.
        _spines(p, 3.4, (30, top + 0.06 * pitch, p.width - 60, 0.86 * pitch))
        p.rectangle((0, top + 0.93 * pitch, p.width, 0.07 * pitch), 0.5)
    for x in (0.0, p.width - 25):
        p.rectangle((x, 0, 25, p.height), 0.45)
    p.rectangle((0, 0, p.width, 25), 0.5)
    roughen(p, 0.035)


def _spines(p: Painter, factor: float, box: tuple[float, float, float, float]) -> None:
    """Stand books of another size on a shelf."""
    x, y, width, height = box
    base, right = y + height, x + width
    while x < right - 14 * factor:
        size, tall, tone = p.between(6, 13) * factor, p.between(0.6, 0.95) * height, p.between(0.12, 0.92)
        if p.happens(0.06):
            x += size * 2
            continue
        p.gradient((x, base - tall, size, tall), tone * 1.06, tone * 0.9)
        ink = 0.95 if tone < 0.5 else 0.08
        p.rectangle((x + 0.12 * size, base - 0.82 * tall, 0.76 * size, 0.02 * tall), ink)
        p.rectangle((x + 0.12 * size, base - 0.24 * tall, 0.76 * size, 0.015 * tall), ink)
        for y_title in np.arange(base - 0.74 * tall, base - 0.34 * tall, 11):
            if p.happens(0.8):
                p.rectangle((x + 0.3 * size, float(y_title), 0.4 * size, 6), ink)
        x += size + 2


def drawers(p: Painter) -> None:
    """Draw the front of a chest of drawers."""
    tone = p.between(0.35, 0.6)
    wood(tone)(p)
    count = max(2, round(p.height / 230))
    for row in range(count):
        top, tall = p.height * row / count, p.height / count
        p.frame((18, top + 14, p.width - 36, tall - 28), tone * 0.5, 8)
        for share in (0.3, 0.7):
            p.ellipse(p.width * share, top + tall / 2, (16, 16), 0.12)
            p.ellipse(p.width * share - 4, top + tall / 2 - 4, (9, 9), 0.8)


def parcel(p: Painter) -> None:
    """Draw the side of a parcel with tape and a label."""
    tone = p.between(0.4, 0.75)
    p.rectangle(all_of(p), tone)
    roughen(p, 0.05)
    p.rectangle((0, 0.44 * p.height, p.width, 0.12 * p.height), tone * 0.7)
    label = (0.12 * p.width, 0.12 * p.height, 0.5 * p.width, 0.3 * p.height)
    p.rectangle(label, 0.95)
    for line in range(4):
        length = label[2] * p.between(0.4, 0.85)
        p.rectangle((label[0] + 0.06 * label[2], label[1] + (0.15 + 0.2 * line) * label[3], length, 0.1 * label[3]), 0.1)
    for bar in range(14):
        p.rectangle((p.width * (0.66 + 0.018 * bar), 0.7 * p.height, p.between(2, 6), 0.2 * p.height), 0.06)


def picture(p: Painter) -> None:
    """Draw a framed picture: a poster, or hills under a sun."""
    rim = 0.06 * min(p.width, p.height)
    p.rectangle(all_of(p), p.between(0.08, 0.3))
    p.frame((0.3 * rim, 0.3 * rim, p.width - 0.6 * rim, p.height - 0.6 * rim), 0.6, 0.15 * rim)
    inside = rim, rim, p.width - 2 * rim, p.height - 2 * rim
    if p.happens(0.5):
        title, line = POSTERS[int(p.rng.integers(len(POSTERS)))]
        poster(p, inside, title, line)
        return
    x, y, width, height = inside
    p.gradient(inside, p.between(0.5, 0.7), 0.97)
    p.ellipse(x + p.between(0.2, 0.8) * width, y + 0.3 * height, (0.09 * width, 0.09 * width), 1.0)
    for ridge in range(5):
        base, tone = y + (0.42 + 0.13 * ridge) * height, 0.62 - 0.12 * ridge
        heights = [base + 0.09 * height * np.sin(p.between(0, 6) + 1.7 * step) for step in range(9)]
        outline = [(x + width * step / 8, min(each, y + height)) for step, each in enumerate(heights)]
        p.polygon([(x, y + height), *outline, (x + width, y + height)], tone)
    for _ in range(60):
        left, low = x + p.between(0.02, 0.96) * width, y + p.between(0.6, 0.97) * height
        size = 0.05 * height * (low - y) / height
        p.polygon([(left - size / 2, low), (left + size / 2, low), (left, max(y, low - 2 * size))], p.between(0.05, 0.3))
    roughen(p, 0.03)


def door(p: Painter) -> None:
    """Draw a panelled door with its frame."""
    tone = p.between(0.55, 0.8)
    wood(tone)(p)
    for top, tall in ((0.08, 0.36), (0.52, 0.38)):
        for left in (0.12, 0.54):
            box = left * p.width, top * p.height, 0.34 * p.width, tall * p.height
            p.frame(box, tone * 0.55, 14)
            p.frame((box[0] + 20, box[1] + 20, box[2] - 40, box[3] - 40), tone * 1.2, 7)
    p.ellipse(0.94 * p.width, 0.5 * p.height, (22, 22), 0.2)
