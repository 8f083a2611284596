"""Ground floors: shop windows, signs, awnings, doors, posters."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photonpano_simulator.street.facades import cat
from photonpano_simulator.street.painter import Box, Painter


class Shop(NamedTuple):
    """What a shop is called and sells."""

    name: str
    motto: str
    goods: str
    menu: tuple[str, ...] = ()


SHOPS = (
    Shop("QUANTA BOOKS", "New, old and rare", "books"),
    Shop(
        "CAFÉ POISSON",
        "Coffee one drop at a time",
        "cakes",
        ("Coffee 1.80", "Latte 2.60", "Cocoa 2.90", "Lemon cake 2.70", "Soup 4.50"),
    ),
    Shop("ZERO & ONE", "Tailors since 1905", "books"),
    Shop("LUMEN OPTICS", "Spectacles, lenses, repairs", "bottles"),
    Shop(
        "AVALANCHE",
        "Ice cream and sorbet",
        "cakes",
        ("Vanilla 1.20", "Pistachio 1.40", "Cherry 1.20", "Lemon 1.10", "Nougat 1.50"),
    ),
    Shop(
        "BAKERY",
        "Bread, rolls, cakes",
        "cakes",
        ("Rye bread 3.10", "Baguette 1.20", "Pretzel 0.80", "Apple pie 2.90", "Plum cake 2.70"),
    ),
    Shop("DARK COUNT", "Hotel and bar", "bottles", ("Lager 3.20", "Porter 3.60", "Cider 3.40", "Olives 2.80", "Room 64.00")),
    Shop("FLUX FLOWERS", "Cut fresh every day", "bottles"),
    Shop("APERTURE", "Records bought and sold", "books"),
    Shop("HALF PIXEL", "Prints and frames", "books"),
)
POSTERS = (
    ("JAZZ", "Friday 9 pm"),
    ("OPEN AIR", "Cinema in the park"),
    ("CIRCUS", "Two shows daily"),
    ("1 000 000 fps", "A short film"),
    ("NOISE", "The concert"),
    ("SALE", "Everything must go"),
    ("LOST CAT", "Answers to Sift"),
    ("MARKET", "Every Saturday"),
)


def front(p: Painter, box: Box, shop: Shop) -> None:
    """Draw a shop: its sign, an awning or none, windows with goods, a door, and a menu on the pavement."""
    x, y, width, height = box
    paint = p.between(0.14, 0.62)
    p.rectangle(box, paint)
    p.grain(box, 0.04, 20)
    p.grain(box, 0.04, 3)
    sign(p, (x + 4, y, width - 8, 0.24 * height), shop, dark=p.happens(0.6))
    top, bottom = y + 0.27 * height, y + height
    door_width = 74
    door_left = p.happens(0.5)
    door_x = x + 16 if door_left else x + width - 16 - door_width
    glass_x = door_x + door_width + 14 if door_left else x + 16
    glass_width = width - door_width - 46
    panels(p, (glass_x, bottom - 0.16 * height, glass_width, 0.14 * height), paint)
    display(p, (glass_x, top, glass_width, 0.56 * height), shop.goods)
    door(p, (door_x, top, door_width, bottom - top), paint)
    if p.happens(0.6):
        awning(p, (x + 6, top - 6, width - 12, 0.2 * height))
    else:
        p.shade((x, top, width, 20), 0.6, 1.0)
    if shop.menu:
        menu(p, (glass_x + p.between(0.1, 0.9) * (glass_width - 76), bottom - 84, 76, 112), shop.menu)


def sign(p: Painter, box: Box, shop: Shop, *, dark: bool) -> None:
    """Letter the board above a shop."""
    x, y, width, height = box
    board, letters = (0.1, 0.95) if dark else (0.9, 0.08)
    p.rectangle(box, board)
    p.grain(box, 0.03, 8)
    p.frame((x + 4, y + 4, width - 8, height - 8), letters, 1.8)
    p.text(shop.name, (x + 14, y + 0.14 * height, width - 28, 0.42 * height), letters, 800)
    p.text(shop.motto, (x + 14, y + 0.67 * height, width - 28, 0.17 * height), letters, 400, "italic")
    p.shade((x, y + height, width, 14), 0.55, 1.0)


def awning(p: Painter, box: Box) -> None:
    """Roll out a striped awning with a scalloped edge."""
    x, y, width, height = box
    stripes = int(width / 19)
    dark = p.between(0.12, 0.4)
    pitch, spread = width / stripes, 7.0
    for index in range(stripes):
        tone = dark if index % 2 else 0.93
        left, right = x + index * pitch, x + (index + 1) * pitch
        low_left, low_right = left + spread * (2 * index / stripes - 1), right + spread * (2 * (index + 1) / stripes - 1)
        p.polygon([(left, y), (right, y), (low_right, y + height), (low_left, y + height)], tone)
        p.ellipse((low_left + low_right) / 2, y + height, (pitch / 2, 9), tone * 0.9, (0, 180))
    p.shade((x - spread, y, width + 2 * spread, height), 1.0, 0.82)
    p.shade((x - spread, y + height + 9, width + 2 * spread, 26), 0.5, 0.95)


def panels(p: Painter, box: Box, tone: float) -> None:
    """Panel the wood below a shop window."""
    x, y, width, height = box
    count = max(1, int(width / 60))
    for left in np.linspace(x, x + width, count + 1)[:-1]:
        frame = (float(left) + 4, y + 4, width / count - 8, height - 8)
        p.rectangle(frame, tone * 1.5)
        p.gradient((frame[0] + 3, frame[1] + 3, frame[2] - 6, frame[3] - 6), tone * 0.7, tone * 1.1)


def door(p: Painter, box: Box, tone: float) -> None:
    """Draw a door with a number above it and a notice on it."""
    x, y, width, height = box
    p.rectangle((x - 5, y, width + 10, height), tone * 1.45)
    p.rectangle(box, tone * 0.75)
    p.gradient((x + 6, y + 6, width - 12, 0.13 * height), 0.7, 0.4)
    p.text(str(int(p.rng.integers(2, 99))), (x + 10, y + 10, width - 20, 0.1 * height), 0.08, 700)
    p.gradient((x + 10, y + 0.2 * height, width - 20, 0.45 * height), 0.42, 0.14)
    notice = (x + 18, y + 0.3 * height, width - 36, 20)
    p.rectangle(notice, 0.93)
    p.text("OPEN" if p.happens(0.7) else "CLOSED", (notice[0] + 2, notice[1] + 4, notice[2] - 4, 12), 0.1, 800)
    for top, size in ((0.69, 0.12), (0.83, 0.13)):
        p.rectangle((x + 10, y + top * height, width - 20, size * height), tone * 1.25)
        p.rectangle((x + 13, y + top * height + 3, width - 26, size * height - 6), tone * 0.6)
    p.ellipse(x + width - 9, y + 0.55 * height, (3.5, 3.5), 0.9)
    p.rectangle((x - 10, y + height - 8, width + 20, 8), 0.6)


def display(p: Painter, box: Box, kind: str) -> None:
    """Fill a shop window with goods."""
    x, y, width, height = box
    p.rectangle((x - 6, y - 6, width + 12, height + 12), 0.82)
    p.gradient(box, 0.14, 0.3)
    shelves = 3
    for shelf in range(shelves):
        level = y + height * (shelf + 1) / shelves
        goods(p, (x + 4, level - 0.92 * height / shelves, width - 8, 0.92 * height / shelves - 5), kind)
        p.rectangle((x, level - 5, width, 5), 0.66)
    reflection = ((0.1, 0), (0.2, 0), (0.08, 0.5), (0, 0.5), (0, 0.42))
    p.polygon([(x + across * width, y + down * height) for across, down in reflection], 0.55)
    for left in np.linspace(x, x + width, max(2, int(width / 110)) + 1):
        p.rectangle((float(left) - 3, y, 6, height), 0.82)


def goods(p: Painter, box: Box, kind: str) -> None:
    """Stand books, bottles or cakes on a shelf."""
    x, y, width, height = box
    base, right = y + height, x + width
    while x < right - 14:
        if kind == "books":
            size, tall = p.between(6, 13), p.between(0.55, 0.95) * height
            tone = p.between(0.15, 0.95)
            p.rectangle((x, base - tall, size, tall), tone)
            p.rectangle((x + 1, base - 0.8 * tall, size - 2, 3), 1 - tone)
            p.rectangle((x + 1, base - 0.25 * tall, size - 2, 2), 1 - tone)
            x += size + 0.8
        elif kind == "bottles":
            size, tall = p.between(11, 16), p.between(0.65, 0.95) * height
            tone = p.between(0.3, 0.85)
            p.rectangle((x, base - 0.62 * tall, size, 0.62 * tall), tone)
            p.rectangle((x + 0.33 * size, base - tall, 0.34 * size, 0.5 * tall), tone)
            p.rectangle((x + 1, base - 0.45 * tall, size - 2, 0.25 * tall), 0.95)
            p.rectangle((x + 2, base - 0.37 * tall, size - 4, 2), 0.2)
            x += size + 3
        else:
            size = p.between(22, 36)
            tone = p.between(0.5, 0.9)
            p.ellipse(x + size / 2, base, (size / 2, p.between(0.35, 0.7) * height), tone, (180, 360))
            for cut in (0.3, 0.5, 0.7):
                p.line([(x + cut * size - 3, base - 2), (x + cut * size + 3, base - 0.3 * height)], tone * 0.55, 1.8)
            x += size + 3


def menu(p: Painter, box: Box, lines: tuple[str, ...]) -> None:
    """Chalk up the prices."""
    x, y, width, height = box
    p.shade((x - 12, y + height - 8, width + 24, 14), 0.55, 0.8)
    p.rectangle((x - 5, y - 5, width + 10, height + 10), 0.66)
    p.rectangle(box, 0.07)
    p.text("Today", (x + 8, y + 9, width - 16, 0.13 * height), 0.97, 700, "italic")
    for index, line in enumerate(lines):
        p.text(line, (x + 5, y + (0.33 + 0.13 * index) * height, width - 10, 0.062 * height), 0.9, 500)


def poster(p: Painter, box: Box, title: str, line: str) -> None:
    """Paste up a poster."""
    x, y, width, height = box
    paper, ink = (0.93, 0.1) if p.happens(0.6) else (0.16, 0.94)
    p.shade((x + 3, y + 4, width, height), 0.6, 0.6)
    p.rectangle(box, paper)
    p.text(title, (x + 5, y + 0.06 * height, width - 10, 0.2 * height), ink, 900)
    emblem(p, (x + 0.14 * width, y + 0.3 * height, 0.72 * width, 0.46 * height), ink, paper, "cat" if "CAT" in title else "")
    p.text(line, (x + 6, y + 0.8 * height, width - 12, 0.1 * height), ink, 500)
    p.grain(box, 0.05, 6)


def emblem(p: Painter, box: Box, ink: float, paper: float, kind: str) -> None:
    """Draw what a poster is about: a cat, a sun, or rings."""
    x, y, width, height = box
    middle, centre = x + width / 2, y + height / 2
    radius = min(width, height) / 2
    if kind == "cat":
        cat(p, (x + 0.1 * width, y, 0.8 * width, height), ink)
    elif p.happens(0.5):
        for angle in np.linspace(0, 2 * np.pi, int(p.rng.integers(8, 15)), endpoint=False):
            turns = (angle, angle + 0.22)
            tips = [(middle + radius * np.cos(turn), centre + radius * np.sin(turn)) for turn in turns]
            p.polygon([(middle, centre), *tips], ink)
        p.ellipse(middle, centre, (0.4 * radius, 0.4 * radius), paper)
        p.ellipse(middle, centre, (0.25 * radius, 0.25 * radius), ink)
    else:
        for index in range(5):
            size = radius * (1 - index / 5)
            p.ellipse(middle + 0.12 * radius * index, centre, (size, size), paper if index % 2 else ink)
