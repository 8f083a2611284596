"""Upper floors: walls, windows, balconies, cornices, roofs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from photonpano_simulator.street.painter import Box, Painter


class Style(NamedTuple):
    """The style of the windows of one house."""

    arched: bool
    shutters: bool
    railing: bool
    panes: tuple[int, int]
    frame: float


_WALLS = ("brick", "brick", "stone", "plaster", "plaster", "boards")


def facade(p: Painter, box: Box, floors: int) -> None:
    """Draw the upper floors of a house, from its cornice down to the shop."""
    x, y, width, height = box
    tone = p.between(0.34, 0.86)
    wall(p, box, p.choice(_WALLS), tone)
    style = Style(
        arched=p.happens(0.35),
        shutters=p.happens(0.4),
        railing=p.happens(0.45),
        panes=(2, int(p.rng.integers(2, 5))),
        frame=0.9 if tone < 0.65 or p.happens(0.5) else 0.18,
    )
    columns = max(2, round(width / p.between(92, 125)))
    floor_height = height / floors
    pitch = width / columns
    window_width = pitch * p.between(0.42, 0.52)
    for floor in range(floors):
        top = y + floor * floor_height
        for column in range(columns):
            left = x + pitch * (column + 0.5) - window_width / 2
            window(p, (left, top + 0.24 * floor_height, window_width, 0.54 * floor_height), style, tone)
        if floor:
            ledge(p, (x, top + 0.02 * floor_height, width, 7), tone)
    if p.happens(0.7):
        quoins(p, box, tone)
    drainpipe(p, x + (6 if p.happens(0.5) else width - 12), y, height)
    p.shade((x, y, width, 46), 0.62, 1.0)
    p.shade((x + width - 7, y, 7, height), 0.8, 0.8)
    cornice(p, (x, y, width, 26), tone)


def wall(p: Painter, box: Box, material: str, tone: float) -> None:
    """Cover a rectangle with brick, stone, boards or plaster, weathered."""
    x, y, width, height = box
    if material == "brick":
        p.bricks(box, (p.between(17, 22), p.between(6.5, 8)), tone, 0.045, tone + 0.17 if tone < 0.55 else tone - 0.2)
    elif material == "stone":
        p.bricks(box, (p.between(48, 66), p.between(22, 28)), tone, 0.05, tone - 0.16)
    elif material == "boards":
        p.rectangle(box, tone)
        for top in np.arange(y, y + height, 11):
            p.gradient((x, float(top), width, 11), tone * 1.06, tone * 0.92)
            p.rectangle((x, float(top), width, 1.4), tone * 0.62)
    else:
        p.rectangle(box, tone)
        for _ in range(int(width * height / 9000)):
            damage(p, (p.between(x, x + width - 60), p.between(y, y + height - 40), p.between(20, 60), p.between(14, 40)), tone)
    p.grain(box, 0.03, 60)
    p.grain(box, 0.04, 14)
    p.grain(box, 0.045, 3)


def damage(p: Painter, box: Box, tone: float) -> None:
    """Let the bricks show where the plaster fell off."""
    x, y, width, height = box
    points = []
    for angle in np.linspace(0, 2 * np.pi, 14, endpoint=False):
        radius = p.between(0.55, 1.0) / 2
        points.append((x + width * (0.5 + radius * np.cos(angle)), y + height * (0.5 + radius * np.sin(angle))))
    p.polygon(points, tone * p.between(0.72, 0.84))
    for top in np.arange(y + 0.3 * height, y + 0.75 * height, 6):
        p.line([(x + 0.28 * width, float(top)), (x + 0.72 * width, float(top))], tone * 0.6, 1)


def window(p: Painter, box: Box, style: Style, tone: float) -> None:
    """Draw a window with its frame, sill and lintel, and what hangs around it."""
    x, y, width, height = box
    middle = x + width / 2
    surround = min(0.95, tone * 1.28) if tone < 0.7 else tone * 0.74
    p.rectangle((x - 6, y - 6, width + 12, height + 12), surround)
    if style.arched:
        p.ellipse(middle, y, (width / 2 + 6, 0.22 * height + 6), surround, (180, 360))
        p.ellipse(middle, y, (width / 2, 0.22 * height), 0.16, (180, 360))
        p.polygon([(middle - 5, y - 0.3 * height), (middle + 5, y - 0.3 * height), (middle, y - 3)], surround * 0.8)
    else:
        p.polygon([(x - 9, y - 17), (x + width + 9, y - 17), (x + width + 4, y - 6), (x - 4, y - 6)], surround * 0.9)
        p.polygon([(middle - 6, y - 20), (middle + 6, y - 20), (middle + 4, y - 6), (middle - 4, y - 6)], surround)
    glass(p, box)
    inside(p, box)
    columns, rows = style.panes
    p.frame(box, style.frame, 4)
    for column in range(1, columns):
        p.line([(x + width * column / columns, y), (x + width * column / columns, y + height)], style.frame, 3.2)
    for row in range(1, rows):
        p.line([(x, y + height * row / rows), (x + width, y + height * row / rows)], style.frame, 2.2)
    p.shade((x, y, width, 9), 0.5, 0.9)
    if style.shutters:
        for left in (x - 8 - 0.46 * width, x + width + 8):
            shutter(p, (left, y - 2, 0.46 * width, height + 6), surround * 0.55 if tone > 0.5 else 0.78)
    p.rectangle((x - 11, y + height + 5, width + 22, 8), min(1, surround * 1.08))
    p.shade((x - 11, y + height + 13, width + 22, 14), 0.6, 1.0)
    if style.railing:
        railing(p, (x - 12, y + 0.62 * height, width + 24, 0.42 * height))
    elif p.happens(0.4):
        flowers(p, (x - 6, y + height - 14, width + 12, 20))


def glass(p: Painter, box: Box) -> None:
    """Reflect the sky."""
    x, y, width, height = box
    p.gradient(box, p.between(0.3, 0.5), p.between(0.1, 0.2))
    if p.happens(0.7):
        slant, middle = 0.35 * width, x + p.between(0.3, 0.8) * width
        left, right = max(x, middle - 0.2 * width), min(x + width, middle + 0.15 * width)
        low_left, low_right = max(x, left - slant), max(x, right - slant)
        p.polygon([(left, y), (right, y), (low_right, y + height), (low_left, y + height)], p.between(0.35, 0.6))


def inside(p: Painter, box: Box) -> None:
    """Show a curtain, a blind, a lamp, or a cat."""
    x, y, width, height = box
    kind = p.choice(("curtains", "blind", "lamp", "dark", "cat", "curtains"))
    if kind == "curtains":
        for left, right in ((x, x + 0.34 * width), (x + 0.66 * width, x + width)):
            for fold, start in enumerate(np.linspace(left, right, 6)[:-1]):
                p.rectangle((float(start), y, (right - left) / 5, height), 0.62 + 0.12 * (fold % 2) + p.between(-0.03, 0.03))
    elif kind == "blind":
        drop = p.between(0.3, 0.8) * height
        for top in np.arange(y, y + drop, 6):
            p.gradient((x, float(top), width, 6), 0.8, 0.55)
    elif kind == "lamp":
        p.gradient(box, 0.78, 0.6)
        shade = ((0.3, 0.45), (0.7, 0.45), (0.6, 0.2), (0.4, 0.2))
        p.polygon([(x + across * width, y + down * height) for across, down in shade], 1.0)
        p.line([(x + 0.5 * width, y), (x + 0.5 * width, y + 0.2 * height)], 0.2, 1.5)
    elif kind == "cat":
        cat(p, (x + p.between(0.2, 0.5) * width, y + 0.68 * height, 0.34 * width, 0.32 * height), 0.04)


def cat(p: Painter, box: Box, tone: float) -> None:
    """Draw a cat that sits."""
    x, y, width, height = box
    p.ellipse(x + 0.45 * width, y + 0.72 * height, (0.42 * width, 0.3 * height), tone)
    p.ellipse(x + 0.68 * width, y + 0.36 * height, (0.28 * width, 0.2 * height), tone)
    for ear in (0.5, 0.86):
        root, half = y + 0.3 * height, 0.1 * width
        p.polygon([(x + ear * width - half, root), (x + ear * width + half, root), (x + ear * width, y)], tone)
    p.line([(x + 0.1 * width, y + 0.8 * height), (x - 0.1 * width, y + 0.5 * height)], tone, 0.08 * width)


def shutter(p: Painter, box: Box, tone: float) -> None:
    """Draw a shutter with its slats."""
    x, y, width, height = box
    p.rectangle(box, tone)
    for top in np.arange(y + 5, y + height - 8, 5.5):
        p.gradient((x + 4, float(top), width - 8, 5.5), tone * 1.25, tone * 0.6)
    p.rectangle((x, y + 0.5 * height - 2, width, 5), tone)
    p.shade((x + width, y, 4, height), 0.7, 0.7)


def railing(p: Painter, box: Box) -> None:
    """Draw a wrought-iron balcony."""
    x, y, width, height = box
    p.shade((x, y, width, height), 0.8, 0.7)
    for left in np.arange(x + 3, x + width, 7.5):
        p.line([(float(left), y), (float(left), y + height)], 0.05, 1.6)
        p.ellipse(float(left), y + 0.5 * height, (2.6, 4), 0.05)
    p.rectangle((x - 3, y - 3, width + 6, 4), 0.05)
    p.rectangle((x - 6, y + height, width + 12, 7), 0.45)
    p.shade((x - 6, y + height + 7, width + 12, 12), 0.55, 1.0)
    if p.happens(0.5):
        flowers(p, (x, y - 8, width, 18))


def flowers(p: Painter, box: Box) -> None:
    """Plant a window box."""
    x, y, width, height = box
    for _ in range(int(width * 1.3)):
        tone = p.between(0.12, 0.4) if p.happens(0.7) else p.between(0.75, 1.0)
        p.ellipse(p.between(x, x + width), p.between(y - 6, y + 0.55 * height), (p.between(1, 3.4), p.between(1, 3.4)), tone)
    p.gradient((x, y + 0.5 * height, width, 0.5 * height), 0.36, 0.22)


def ledge(p: Painter, box: Box, tone: float) -> None:
    """Run a string course along a floor."""
    x, y, width, height = box
    p.rectangle(box, min(1, tone * 1.22))
    p.shade((x, y + height, width, 9), 0.66, 1.0)


def quoins(p: Painter, box: Box, tone: float) -> None:
    """Set corner stones."""
    x, y, width, height = box
    stone = min(0.97, tone * 1.25) if tone < 0.7 else tone * 0.8
    for index, top in enumerate(np.arange(y, y + height - 24, 26)):
        length = 30 if index % 2 else 20
        for left in (x, x + width - length):
            p.gradient((left, float(top), length, 24), stone, stone * 0.93)
            p.rectangle((left, float(top) + 24, length, 2), stone * 0.6)


def drainpipe(p: Painter, x: float, y: float, height: float) -> None:
    """Hang a pipe."""
    p.rectangle((x, y, 6, height), 0.25)
    p.rectangle((x + 1.2, y, 1.6, height), 0.5)
    for top in np.arange(y + 40, y + height, 95):
        p.rectangle((x - 2, float(top), 10, 6), 0.2)


def cornice(p: Painter, box: Box, tone: float) -> None:
    """Crown the wall."""
    x, y, width, height = box
    light = min(0.97, tone * 1.3)
    p.gradient((x - 6, y - 0.4 * height, width + 12, 0.5 * height), light, light * 0.85)
    p.rectangle((x - 3, y + 0.1 * height, width + 6, 0.16 * height), tone * 0.5)
    for left in np.arange(x + 4, x + width - 4, 15):
        p.gradient((float(left), y + 0.26 * height, 8, 0.5 * height), light * 0.95, light * 0.7)


def roof(p: Painter, box: Box) -> None:
    """Draw a tiled roof with dormers, chimneys and aerials, above `y + height`."""
    x, y, width, height = box
    tone = p.between(0.25, 0.45)
    for index, top in enumerate(np.arange(y, y + height, 8)):
        inset = 0.25 * height * (1 - (float(top) - y) / height)
        row = (x + inset, float(top), width - 2 * inset, 8)
        p.bricks(row, (13, 8), tone + 0.015 * (index % 2), 0.05, tone * 0.55)
    for middle in np.linspace(x, x + width, 4)[1:-1]:
        left, top = float(middle) - 20, y + 0.3 * height
        p.polygon([(left - 8, top), (left + 20, top - 22), (left + 48, top)], tone * 0.7)
        p.rectangle((left, top, 40, 0.66 * height), 0.78)
        p.gradient((left + 6, top + 6, 28, 0.66 * height - 10), 0.5, 0.12)
        p.rectangle((left + 18.5, top + 6, 3, 0.66 * height - 10), 0.88)
        p.rectangle((left + 6, top + 0.3 * height, 28, 3), 0.88)
    chimney(p, x + p.between(0.12, 0.3) * width, y + 0.2 * height)
    chimney(p, x + p.between(0.7, 0.85) * width, y + 0.2 * height)
    aerial(p, x + p.between(0.35, 0.65) * width, y)


def chimney(p: Painter, x: float, base: float) -> None:
    """Build a chimney with its pots."""
    height, width = p.between(56, 80), p.between(30, 46)
    p.bricks((x, base - height, width, height), (12, 6), 0.42, 0.06, 0.62)
    p.shade((x + 0.75 * width, base - height, 0.25 * width, height), 0.7, 0.7)
    p.rectangle((x - 4, base - height, width + 8, 7), 0.55)
    for left in (x + 3, x + width - 13):
        p.gradient((left, base - height - 17, 10, 17), 0.6, 0.42)


def aerial(p: Painter, x: float, base: float) -> None:
    """Put up a television aerial."""
    height = p.between(50, 75)
    p.line([(x, base), (x, base - height)], 0.15, 2.4)
    for index, top in enumerate((0, 9, 18, 27)):
        half = 22 - 3 * index
        p.line([(x - half, base - height + top), (x + half, base - height + top - 3)], 0.15, 1.7)
