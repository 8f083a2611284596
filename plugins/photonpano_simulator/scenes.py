"""Scenes as pictures: the flux of a photograph, or of the street that a YAML file describes, by day or at night.

A picture is a list of marks, which are drawn one over the other. A mark is a mapping with these keys:

    box: [x, y, width, height] in the box of the picture; all of it by default. `up` is the same with y from the bottom up
    cells: [width, height] of cells that fill the box, each with the mark; 0 is the side of the box, and cells whose size is
        [low, high] differ from each other
    scatter, size: marks of this [width, height] at random places of the box, so many on 100x100 units
    chance: the chance that it is drawn
    pick: names and what they stand for in this mark and in the pictures that it draws; of a list one is taken, and what is a
        mapping adds its names
    draw: the name of a picture, a list of names, or marks
    tone: from 0, black, to 1, white, as the eye sees them (sRGB); `to` is the tone at the bottom
    shade: a factor of what is there; `to` is that at the bottom
    shape: `disc`, or the corners of a polygon, as shares of the box; a rectangle by default
    bricks: [width, height], of a `tone` with a standard deviation of `spread`, and of joints of the tone `joint`
    noise: [amount, finest, coarsest]: 1/f noise from spots of one size to spots of another, by which tones are multiplied
    text: letters, or a list of them, as large as fit, in a `tone`, of a `weight` from 100 to 900 and a `font`, sans or italic

A number is written as itself, as a share of the side of the box ("30%", "100%-20"), as a name ("wall", "wall*0.8"), as
[low, high] for any number between, or as a longer list, of which one is taken.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.photometry import srgb_to_linear
from photonpano.reading import read_picture
from photonpano_simulator.config import Lamp, NightScene, PhotoScene, StreetScene

_OVERSAMPLING = 2  # shapes are drawn at twice the resolution and averaged down, which smooths their edges
_FRACTION_BITS = 4
_OCTAVE = 3.0  # ratio of the sizes of spots of 1/f noise

Box: TypeAlias = tuple[float, float, float, float]
"""x, y, width, height."""
Mark: TypeAlias = Mapping[str, Any]
Names: TypeAlias = Mapping[str, Any]
Pictures: TypeAlias = Mapping[str, Sequence[Mark]]

_NUMBER = re.compile(r"(?:(?P<percent>-?[\d.]+)%|(?P<name>[a-z_]+)(?:\*(?P<factor>[\d.]+))?)?(?P<plus>[+-]?[\d.]+)?")


@cache
def read_scene(name: str) -> dict[str, Any]:
    """Return the content of the file of a scene of this package."""
    from ruamel.yaml import YAML

    path = Path(__file__).parent / "data" / f"{name}.yaml"
    content: dict[str, Any] = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    return content


@cache
def pictures_of(name: str) -> Pictures:
    """Return the pictures by name that a scene may use: those of all scenes, and its own."""
    return {**read_scene("materials"), **read_scene("street")["pictures"], **read_scene(name).get("pictures", {})}


@cache
def _parsed(written: str) -> tuple[float, str | None, float, float]:
    """Return the share, the name and its factor, and the number of which a written number is the sum."""
    found = _NUMBER.fullmatch(written)
    if found is None:
        raise ValueError(f"{written!r} is no number of a scene")
    return float(found["percent"] or 0) / 100, found["name"], float(found["factor"] or 1), float(found["plus"] or 0)


class Chance:
    """Draws numbers and chooses from lists; a list is used up before one of its items comes again."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._decks: dict[int, list[Any]] = {}

    def one(self, items: Sequence[Any]) -> Any:
        """Choose an item."""
        deck = self._decks.setdefault(id(items), [])
        if not deck:
            deck.extend(items[place] for place in self.rng.permutation(len(items)))
        return deck.pop()

    def number(self, value: Any, names: Names, side: float = 0.0) -> float:
        """Return a number as it is written in a mark; shares are those of a side."""
        if isinstance(value, int | float):
            return value
        if isinstance(value, list):
            if len(value) != 2:
                return self.number(self.one(value), names, side)
            low, high = self.number(value[0], names, side), self.number(value[1], names, side)
            return low + (high - low) * self.rng.random()
        share, name, factor, total = _parsed(value)
        if name:
            total += factor * self.number(names[name], names, side)
        return total + share * side

    def picked(self, names: Names, pick: Names) -> Names:
        """Return names with those that a mark picks."""
        found = dict(names)
        for name, value in pick.items():
            is_choice = isinstance(value, list) and not isinstance(value[0], int | float)
            chosen = self.one(value) if is_choice else self.number(value, names) if isinstance(value, list) else value
            found = dict(self.picked(found, chosen)) if isinstance(chosen, dict) else found | {name: chosen}
        return found


class Drawing(Chance):
    """Draws a picture of (height, width) px from pictures that marks may name.

    Convention:
        Lengths are in units of the picture, which is `height` units high whatever its size in pixels; x right, y down.
    """

    def __init__(self, shape: tuple[int, int], height: float, pictures: Pictures, rng: np.random.Generator) -> None:
        super().__init__(rng)
        self._shape, self._pictures = shape, pictures
        self._scale = _OVERSAMPLING * shape[0] / height
        self._image = np.zeros((_OVERSAMPLING * shape[0], _OVERSAMPLING * shape[1]), np.float32)
        self._all: Box = (0.0, 0.0, height * shape[1] / shape[0], height)

    def finished(self, picture: str, names: Names) -> NDArray[np.float32]:
        """Draw a picture; return (height, width) px, tones in [0, 1]."""
        self._draw(picture, self._all, names)
        height, width = self._shape
        return np.clip(cv2.resize(self._image, (width, height), interpolation=cv2.INTER_AREA), 0, 1)

    def _draw(self, picture: str | Sequence[Mark], box: Box, names: Names) -> None:
        if isinstance(picture, str):
            picture = self._pictures[names.get(picture, picture)]
        for mark in picture:
            for place in self._places(mark, box, names):
                if "chance" not in mark or self.rng.random() < mark["chance"]:
                    self._mark(mark, place, self.picked(names, mark["pick"]) if "pick" in mark else names)

    def _places(self, mark: Mark, parent: Box, names: Names) -> Iterator[Box]:
        x, y, width, height = self._box(mark, parent, names)
        if "scatter" in mark:
            for _ in range(round(mark["scatter"] * width * height / 1e4)):
                sizes = self.number(mark["size"][0], names, width), self.number(mark["size"][1], names, height)
                yield (x + self.rng.uniform(0, width), y + self.rng.uniform(0, height), *sizes)
        elif "cells" in mark:
            across, down = mark["cells"]
            for top, tall in list(self._cells(down, height, names)):
                for left, wide in self._cells(across, width, names):
                    yield x + left, y + top, wide, tall
        else:
            yield x, y, width, height

    def _box(self, mark: Mark, parent: Box, names: Names) -> Box:
        written = mark.get("up", mark.get("box"))
        if written is None:
            return parent
        sides = (parent[2], parent[3]) * 2
        x, y, width, height = (self.number(value, names, side) for value, side in zip(written, sides, strict=True))
        top = parent[3] - y - height if "up" in mark else y
        return parent[0] + x, parent[1] + top, width, height

    def _cells(self, size: Any, side: float, names: Names) -> Iterator[tuple[float, float]]:
        """Yield start and length of the cells along a side."""
        if isinstance(size, list):
            at, length = 0.0, self.number(size, names, side)
            while at + length <= side:
                yield at, length
                at, length = at + length, self.number(size, names, side)
        else:
            wanted = self.number(size, names, side)
            count = max(1, round(side / wanted)) if wanted else 1
            for place in range(count):
                yield place * side / count, side / count

    def _mark(self, mark: Mark, box: Box, names: Names) -> None:
        if "draw" in mark:
            drawn = mark["draw"]
            is_choice = isinstance(drawn, list) and isinstance(drawn[0], str)
            self._draw(self.one(drawn) if is_choice else drawn, box, names)
        elif "text" in mark:
            text = mark["text"]
            text = self.one(text) if isinstance(text, list) else str(names.get(text, text))
            self._write(text, box, self.number(mark["tone"], names), mark.get("weight", 500), mark.get("font", "sans"))
        elif "bricks" in mark:
            self._bricks(mark, box, names)
        elif "noise" in mark:
            amount, finest, coarsest = (self.number(each, names) for each in mark["noise"])
            region = self._region(box)
            while coarsest >= finest:
                region *= 1 + amount * self._noise(region.shape, coarsest)
                coarsest /= _OCTAVE
        elif "shape" in mark:
            self._shape_of(mark["shape"], box, self.number(mark["tone"], names))
        else:
            tone = self.number(mark["tone" if "tone" in mark else "shade"], names)
            region = self._region(box)
            tones: NDArray[np.float32] = np.array([[tone]], np.float32)
            if "to" in mark:
                tones = np.linspace(tone, self.number(mark["to"], names), region.shape[0], dtype=np.float32)[:, None]
            region[:] = tones if "tone" in mark else region * tones

    def _shape_of(self, shape: Any, box: Box, tone: float) -> None:
        """Fill a disc, or a polygon with corners at shares of the box."""
        x, y, width, height = box
        if shape == "disc":
            middle, radii = self._fixed([(x + width / 2, y + height / 2), (width / 2, height / 2)]).tolist()
            cv2.ellipse(self._image, middle, radii, 0, 0, 360, tone, -1, cv2.LINE_8, _FRACTION_BITS)
        else:
            points = [(x + width * float(point[0]), y + height * float(point[1])) for point in shape]
            cv2.fillPoly(self._image, [self._fixed(points)], tone, cv2.LINE_8, _FRACTION_BITS)

    def _bricks(self, mark: Mark, box: Box, names: Names) -> None:
        """Fill a box with courses of bricks, every other one shifted by half a brick."""
        region = self._region(box)
        width, height = (max(3, round(self.number(value, names) * self._scale)) for value in mark["bricks"])
        tone, joint = self.number(mark["tone"], names), self.number(mark["joint"], names)
        joint_px = max(1, round(0.012 * (width + height) + 0.4 * self._scale))
        for course, top in enumerate(range(0, region.shape[0], height)):
            tones = tone * (1 + mark["spread"] * self.rng.standard_normal(region.shape[1] // width + 2, dtype=np.float32))
            row = np.repeat(tones, width)
            row.reshape(-1, width)[:, :joint_px] = joint
            start = width // 2 * (course % 2)
            region[top : top + height] = row[start : start + region.shape[1]]
            region[top : top + joint_px] = joint

    def _noise(self, shape: tuple[int, ...], cell: float) -> NDArray[np.float32]:
        """Return smooth noise of unit variance, roughly, with spots of `cell` units."""
        step = max(1.0, cell * self._scale)
        rows, columns = (int(np.ceil(size / step)) + 1 for size in shape)
        coarse = self.rng.standard_normal((rows, columns), dtype=np.float32)
        if 0 in shape:
            return np.zeros(shape, np.float32)
        return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC).astype(np.float32, copy=False)

    def _write(self, text: str, box: Box, tone: float, weight: int, font: str) -> None:
        """Write a line in the middle of a box, as large as fits."""
        x, y, width, height = (value * self._scale for value in box)
        face, probe = cv2.FontFace(font), 100
        _, _, text_width, _ = cv2.getTextSize((0, 0), text, (0, 0), face, probe, weight)
        # Capitals are 0.7 of the font's size.
        size = int(min(height / 0.7, width * probe / max(1, text_width)))
        if size < 6:
            return
        left, baseline = x + (width - text_width * size / probe) / 2, y + (height + 0.7 * size) / 2
        top, margin = int(baseline - size), int(0.4 * size)
        rows = slice(max(0, top), max(0, min(self._image.shape[0], int(baseline) + margin)))
        columns = slice(max(0, int(left) - margin), max(0, min(self._image.shape[1], int(x + width) + margin)))
        region = self._image[rows, columns]
        if region.size:
            mask = np.zeros(region.shape, np.uint8)
            cv2.putText(mask, text, (int(left) - columns.start, int(baseline) - rows.start), 255, face, size, weight)
            region += (tone - region) * (mask / np.float32(255))

    def _region(self, box: Box) -> NDArray[np.float32]:
        x, y, width, height = box
        rows = slice(*(max(0, round(value * self._scale)) for value in (y, y + height)))
        columns = slice(*(max(0, round(value * self._scale)) for value in (x, x + width)))
        return self._image[rows, columns]

    def _fixed(self, points: Sequence[tuple[float, float]]) -> NDArray[np.int32]:
        """Return OpenCV's fixed-point pixels."""
        fixed: NDArray[np.int32] = np.round(np.asarray(points) * (self._scale * 2**_FRACTION_BITS)).astype(np.int32)
        return fixed


_LUMINANCE = (0.0722, 0.7152, 0.2126)  # of blue, green and red, in the order of OpenCV (IEC 61966-2-1)
_OVERLAP = 40  # the ends of a drawing all around fade into each other over this part of its width
_LARGEST = 16384  # px; warps of OpenCV refuse a side of 32768 px
_NIGHT_BLUR_PX = 1.0  # nothing at night is sharper than a pixel
_PATCHES = 160  # patches of colour in a square of the street's height
_COLOUR_STD, _STRONGEST_COLOUR = 2.0, 1.5  # of the logarithms of red and blue, relative to green


def scene_flux(
    scene: StreetScene | NightScene | PhotoScene, flux: float, in_colour: bool = False, is_round: bool = False
) -> NDArray[np.float32]:
    """Return the flux of a scene, (Hs, Ws) or (Hs, Ws, 3) in colour, in photons per pixel per frame.

    `flux` is the mean, in colour that of the sum of red, green and blue. The ends of a drawing that `is_round` meet; those of a
    photograph are taken as they are. Raises an `InputError` if the photograph cannot be used.
    """
    if isinstance(scene, PhotoScene):
        linear = photograph(scene.file, scene.width, in_colour)
    else:
        overlap = max(2, scene.width // _OVERLAP) if is_round else 0
        shape = scene.height, scene.width + overlap
        linear = srgb_to_linear(street(shape, scene.seed))
        if isinstance(scene, NightScene):
            linear = _at_night(linear, scene.seed, scene.range_db)
        if in_colour:
            linear = linear[..., None] * _paint(shape, scene.seed)
        if is_round:
            linear = _joined(linear, overlap)
    mean = float(linear.mean(dtype=np.float64)) * (3 if in_colour else 1)
    if mean == 0 and isinstance(scene, PhotoScene):
        raise InputError(f"{scene.file} is black: no flux can be made of it; take another photograph")
    linear *= np.float32(flux / mean)
    return linear


def street(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Draw a street of shops: (height, width) tones in [0, 1], encoded as sRGB; a wider street has more houses."""
    drawing = Drawing(shape, read_scene("street")["height"], pictures_of("street"), np.random.default_rng(seed))
    return drawing.finished("street", {})


def _at_night(paint: NDArray[np.float32], seed: int, range_db: float) -> NDArray[np.float32]:
    """Light a street, (H, W) of linear reflectance, by lamps and windows; return intensities of at most 1."""
    light_of = read_scene("street")["night"]
    lamps, windows = light_of["lamps"], light_of["windows"]
    rng = np.random.default_rng((seed, 1))
    height, width = paint.shape
    unit = height / read_scene("street")["height"]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    light, glow = np.full(paint.shape, light_of["sky"], np.float32), np.zeros(paint.shape, np.float32)
    n_lamps = max(2, round(width / unit / lamps["every"]))
    for place in range(n_lamps):
        lamp_x = (place + rng.uniform(0.25, 0.75)) * width / n_lamps
        lamp_y, strength = rng.uniform(*lamps["between"]) * unit, 10 ** rng.uniform(-0.7, 0)
        distance2 = ((x - lamp_x) ** 2 + (y - lamp_y) ** 2) / (lamps["pool"] * unit) ** 2
        light += np.float32(strength) / (1 + distance2) ** 1.5
        glow += np.float32(strength * lamps["light"]) * np.exp(-distance2 * np.float32((lamps["pool"] / lamps["bulb"]) ** 2))
    wide, tall = (side * unit for side in windows["size"])
    for _ in range(round(windows["for_each_lamp"] * n_lamps)):
        left, top = rng.uniform(0, width), rng.uniform(*windows["between"]) / 100 * height
        box = np.s_[int(top) : int(top + tall) + 1, int(left) : int(left + wide) + 1]
        light[box] += np.float32(windows["light"] * 10 ** rng.uniform(-1, 0))
    scene = cv2.GaussianBlur(np.maximum(paint, np.float32(0.02)) * light + glow, (0, 0), _NIGHT_BLUR_PX)
    stops = np.log(scene / scene.max())
    return np.asarray(np.exp(stops * (range_db / 20 * np.log(10) / -stops.min())), np.float32)


def _paint(shape: tuple[int, int], seed: int) -> NDArray[np.float32]:
    """Return shares of red, green and blue whose sum is 1, (H, W, 3): patches of strong and pale colours, with sharp edges."""
    from scipy.spatial import KDTree

    height, width = shape
    rng = np.random.default_rng((seed, 1))
    n_patches = max(8, round(_PATCHES * width / height))
    places = rng.uniform((0, 0), (height, width), (n_patches, 2))
    logs = np.clip(_COLOUR_STD * rng.standard_normal((n_patches, 2)), -_STRONGEST_COLOUR, _STRONGEST_COLOUR)
    shares = np.exp(np.stack([logs[:, 0], np.zeros(n_patches), logs[:, 1]], axis=-1))
    shares /= shares.sum(axis=-1, keepdims=True)
    nearest = KDTree(places).query(np.indices(shape).reshape(2, -1).T)[1].reshape(shape)
    return np.asarray(shares[nearest], np.float32)


def _joined(linear: NDArray[np.float32], overlap: int) -> NDArray[np.float32]:
    """Fade the last columns of a drawing into the first ones, so that its ends meet; it loses `overlap` columns."""
    share = ((np.arange(overlap, dtype=np.float32) + 0.5) / overlap).reshape(-1, *[1] * (linear.ndim - 2))
    joined = linear[:, :-overlap].copy()
    joined[:, :overlap] = share * linear[:, :overlap] + (1 - share) * linear[:, -overlap:]
    return joined


def photograph(path: Path, width: int | None = None, in_colour: bool = False) -> NDArray[np.float32]:
    """Return the linear luminance of a photograph, from 0 to 1, or its linear red, green and blue, (H, W, 3), at a width in px.

    Raises an `InputError` if the file is no image of 8 or 16 bits, or it is too large.
    """
    otherwise = "is not an image that OpenCV reads; save it as PNG or JPEG"
    image = read_picture(path, otherwise, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} holds {image.dtype} values; a photograph has 8 or 16 bits: save it as PNG")
    # Convert a table of all grey levels, and not every pixel.
    linear_of = srgb_to_linear(np.linspace(0, 1, 256**image.dtype.itemsize, dtype=np.float32))
    linear: NDArray[np.float32]
    if in_colour:
        linear = linear_of[image[..., ::-1]]
    else:
        linear = np.zeros(image.shape[:2], np.float32)
        for channel, share in enumerate(_LUMINANCE):
            linear += (np.float32(share) * linear_of)[image[..., channel]]
    if width is not None:
        height = max(1, round(linear.shape[0] * width / linear.shape[1]))
        shrinks = width < linear.shape[1]
        linear = cv2.resize(linear, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR).astype(
            np.float32
        )
    if max(linear.shape[:2]) > _LARGEST:
        raise InputError(
            f"{path} is {linear.shape[0]}x{linear.shape[1]} px; set scene.width so that no side exceeds {_LARGEST} px"
        )
    return linear


def brightness(lamp: Lamp, n_frames: int, frame_rate_hz: float) -> NDArray[np.float64]:
    """Return the light of a lamp in each frame: (n_frames,), 1 on average."""
    turns = np.arange(n_frames) / frame_rate_hz * lamp.frequency_hz
    return np.asarray(1 + lamp.depth * np.cos(2 * np.pi * turns + np.deg2rad(lamp.phase_deg)))


def shares(lamps: tuple[Lamp, ...], scene_shape: tuple[int, int], is_round: bool = False) -> NDArray[np.float32]:
    """Return the share of each lamp in the light of each place of the scene, (N, Hs, Ws), whose ends meet if it `is_round`.

    Where the lamps together would give more than all of the light, each gives less.
    """
    height, width = scene_shape
    found = np.ones((len(lamps), height, width), np.float32)
    for lamp, share in zip(lamps, found, strict=True):
        if lamp.at is not None:
            x, y = lamp.at[0] * width - 0.5, lamp.at[1] * height - 0.5
            std_px = lamp.radius * height
            beside = np.arange(width) - x
            if is_round:
                beside = np.mod(beside + width / 2, width) - width / 2
            across = np.exp(-(beside**2) / (2 * std_px**2))
            down = np.exp(-((np.arange(height) - y) ** 2) / (2 * std_px**2))
            share[:] = np.outer(down, across)
    return np.asarray(found / np.maximum(found.sum(axis=0), 1), np.float32)
