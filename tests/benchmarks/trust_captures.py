"""Kinds of captures that are hard to run, each with a known truth; `trust.py` runs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from harness import RATE_HZ

Settings: TypeAlias = dict[str, Any]


@dataclass(frozen=True)
class Size:
    """How large the captures are.

    Attributes:
        frame_shape: (height, width) of a frame, in px.
        long: number of frames, and length of the path in px, of captures along a random spline.
    """

    frame_shape: tuple[int, int]
    long: tuple[int, float]


FULL, SMALL = Size((254, 496), (10_000, 1500.0)), Size((128, 192), (4000, 600.0))
STREET_SHAPE = (1365, 2048)  # (height, width) of the street
TINY = Size((96, 144), (1600, 240.0))  # of captures for cuts


@dataclass(frozen=True)
class Row:
    """A kind of capture.

    Attributes:
        base: name of the undisturbed capture, of `bases`.
        changes: of the size of frames, what else the simulator is told.
        spec: sections of the run's spec, where they are not the defaults.
        picture: paints the scene with a seed, where it is not the street: uint8 or uint16.
        way: the path, instead of that of the base: shifts (T, 2) in px from the middle of the scene, of T frames.
        order: indices of the frames that are written, of T frames that are taken.
        repack: writes the frames of a packed capture as somebody else might have.
    """

    base: str
    changes: Callable[[Size], Settings] = lambda _: {}
    spec: Settings = field(default_factory=dict)
    picture: Callable[[int], np.ndarray] | None = None
    way: Callable[[int], np.ndarray] | None = None
    order: Callable[[int], np.ndarray] | None = None
    repack: Callable[[np.ndarray, int], np.ndarray] | None = None


def bases(size: Size) -> dict[str, Settings]:
    """Return the captures that nothing disturbs."""
    n_frames, length_px = size.long
    pan = {"kind": "pan", "angle_deg": 17}
    spline = {"kind": "random-spline", "length_px": length_px}
    return {
        "clean pan": {"path": {**pan, "length_px": 300}, "n_frames": 2000, "flux": 0.5},
        "clean pan, flux 0.01": {"path": {**pan, "length_px": 150}, "n_frames": 2000, "flux": 0.01},
        "pan of 1.5 px a frame": {"path": {**pan, "angle_deg": 10, "length_px": 1500}, "n_frames": 1000, "flux": 0.5},
        "clean, flux 0.5": {"path": spline, "n_frames": n_frames, "flux": 0.5},
        "clean, flux 0.1": {"path": spline, "n_frames": n_frames, "flux": 0.1},
        "clean, flux 0.02": {"path": spline, "n_frames": n_frames, "flux": 0.02},
        "clean tutorial": {"path": {**spline, "length_px": 300}, "n_frames": 3000, "flux": 0.2},
    }


def shaken(size: Size, base: str, rms_px: float, frequencies_hz: Sequence[float]) -> Settings:
    """Return a base with tremor."""
    shake = {"rms_px": rms_px, "roll_rms_deg": 0, "frequencies_hz": list(frequencies_hz)}
    return {"path": bases(size)[base]["path"] | {"shake": shake}}


def standing(share: float) -> Settings:
    """Return an object that stands in the frame and covers a share of it."""
    return {"objects": [{"size": [share**0.5] * 2, "seed": 1}]}


def moving(share: float, size: Size) -> Settings:
    """Return an object that covers a share of the frame, and moves through a fifth of it, against the scene."""
    travel = 0.2 * size.frame_shape[1]
    moves = [travel / 2000, travel / 6000]
    return {"objects": [{"size": [share**0.5] * 2, "at": [0.4, 0.45], "moves_px": moves, "seed": 1}]}


def crossing(size: Size) -> Settings:
    """Return an object as high as the frame and half as wide, which crosses it from left to right."""
    return {"objects": [{"size": [0.5, 1.0], "at": [-0.25, 0.5], "moves_px": [1.5 * size.frame_shape[1] / 2000, 0], "seed": 1}]}


def panels(seed: int) -> np.ndarray:
    """Paint a facade of equal panels, which differ by 2 % only."""
    rng = np.random.default_rng(seed)
    panel = np.full((80, 60), 0.7)
    panel[8:60, 8:52] = 0.15
    panel[12:56, 12:29] = 0.3 + 0.1 * rng.random()
    panel[12:56, 32:48] = 0.5
    facade = np.tile(panel, (18, 35))
    noise = cv2.GaussianBlur(rng.standard_normal(facade.shape), (0, 0), 3)
    return np.uint8(255 * np.clip(facade * (1 + 0.02 * noise / noise.std()), 0, 1))


def checkerboard(_: int) -> np.ndarray:
    """Paint a board of squares of 8 px."""
    return np.uint8(200 * ((np.indices((1365, 2048)) // 8).sum(axis=0) % 2) + 30)


def stripes(_: int) -> np.ndarray:
    """Paint upright stripes of 6 px."""
    return np.uint8(200 * (np.indices((1365, 2048))[1] // 6 % 2) + 30)


def bounded(seed: int) -> np.ndarray:
    """Paint a texture that ends on both sides in a plain wall."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.standard_normal((500, 800)), (0, 0), 2)
    inside = np.clip((130 - abs(np.arange(800) - 400)) / 20, 0, 1)
    return np.uint8(np.clip(120 + 60 * inside * texture / texture.std(), 1, 255))


def horizon(seed: int) -> np.ndarray:
    """Paint a sea under the sky, with little texture along the horizon."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((500, 800)), (0, 0), 3)
    sides = np.where(np.arange(500)[:, None] > 255, 60, 150)
    return np.uint8(sides + 6 * noise / noise.std())


def half_black(seed: int) -> np.ndarray:
    """Paint a texture whose lower half is black."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal((600, 900)), (0, 0), 2)
    lit = np.clip((300 - np.arange(600)[:, None]) / 3, 0, 1)
    return np.uint8(np.clip((120 + 50 * noise / noise.std()) * lit, 0, 255))


def photograph(file: Path, size: Size, _: int) -> np.ndarray:
    """Read a photograph, five times as high as a frame."""
    picture, height = cv2.imread(str(file)), 5 * size.frame_shape[0]
    width = round(picture.shape[1] * height / picture.shape[0])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def along(progress: np.ndarray, across: np.ndarray | float = 0.0) -> np.ndarray:
    """Return the way of a pan of 300 px with this (T,) progress from 0 to 1, and px across it."""
    return np.stack([300 * (progress - 0.5), 80 * (progress - 0.5) + across], axis=1)


def accelerating(n_frames: int) -> np.ndarray:
    """Return a pan from rest that is fastest at its end: 0.75 px a frame."""
    return along(np.linspace(0, 1, n_frames) ** 5)


def jerking(n_frames: int) -> np.ndarray:
    """Return a pan with three jerks across it: 8 px within 30 frames."""
    frames = np.arange(n_frames)
    jerks = sum(8 / (1 + np.exp(-(frames - share * n_frames) / 5)) for share in (0.31, 0.52, 0.87))
    return along(frames / n_frames, jerks)


def kicked_at_its_ends(n_frames: int) -> np.ndarray:
    """Return a pan whose first and last 40 frames bend off by 6 px."""
    frames = np.arange(n_frames)
    kick = sum(6 * np.clip(1 - each / 40, 0, None) ** 2 for each in (frames, n_frames - 1 - frames))
    return along(frames / n_frames, kick)


def tapped(n_frames: int) -> np.ndarray:
    """Return a pan of a camera that is tapped five times: oscillations of 5 px, every 60 frames, that die down."""
    frames = np.arange(n_frames)
    taps = sum(
        np.where(frames >= start, 5 * np.exp((start - frames) / 40) * np.sin(2 * np.pi * (frames - start) / 60), 0)
        for start in (150, 500, 900, 1350, n_frames - 70)
    )
    return along(frames / n_frames, taps)


def stopping(n_frames: int) -> np.ndarray:
    """Return a pan that stops from one frame to the next, and goes on."""
    return along(np.minimum(np.arange(n_frames), 700) / n_frames + np.clip(np.arange(n_frames) - 1100, 0, None) / n_frames)


def sine(period: float, n_frames: int) -> np.ndarray:
    """Return a pan with a sine of 1 px across it."""
    frames = np.arange(n_frames)
    return along(frames / n_frames, np.sin(2 * np.pi * frames / period))


def shuffled(within: int, n_frames: int) -> np.ndarray:
    """Return an order in which frames stay within so many of their place."""
    return np.argsort(np.arange(n_frames) + np.random.default_rng(0).uniform(0, within, n_frames))


def changed(settings: Settings) -> Callable[[Size], Settings]:
    """Return changes that do not depend on the size."""
    return lambda _: settings


PAN, DIM, LONG = "clean pan", "clean pan, flux 0.01", "clean, flux 0.1"
ROWS: dict[str, Row] = {
    **{name: Row(name) for name in bases(FULL)},
    "tremor of 1 px": Row(LONG, lambda size: shaken(size, LONG, 1, (223, 590, 1270))),
    "tutorial": Row("clean tutorial", lambda size: shaken(size, "clean tutorial", 2, (25, 120, 400))),
    "vibration of 3 px": Row(PAN, lambda size: shaken(size, PAN, 3, (1000,))),
    **{
        f"shaking by {rms_px:g} px every {period:g} frames": Row(
            PAN, lambda size, rms_px=rms_px, period=period: shaken(size, PAN, rms_px, (RATE_HZ / period,))
        )
        for rms_px, period in ((2, 12), (0.7, 12.5), (0.7, 11.5), (0.35, 6.2), (1, 4), (1.4, 3), (1.4, 2))
    },
    "strong shake": Row(PAN, lambda size: shaken(size, PAN, 10, (25, 90, 210))),
    "hot pixels 5 %": Row(DIM, changed({"sensor": {"hot_fraction": 0.05, "dark_rate": 0.001}})),
    "hot pixels 20 %": Row(DIM, changed({"sensor": {"hot_fraction": 0.2, "dark_rate": 0.001}})),
    "hot pixels, lens covered": Row(DIM, changed({"flux": 1e-9, "sensor": {"hot_fraction": 0.05, "dark_rate": 0.001}})),
    "gain 5 %, dirt": Row(PAN, changed({"sensor": {"gain_std": 0.05, "dirt": {}}})),
    **{f"window over {share:.0%}": Row(PAN, changed(standing(share))) for share in (0.3, 0.5, 0.7, 0.9)},
    **{f"lens k1 {k1:.1%}": Row(PAN, changed({"lens": {"k1": k1}})) for k1 in (-0.005, -0.01, -0.03, -0.1)},
    **{f"vignette {loss:.0%}": Row(PAN, changed({"lens": {"vignette": loss}})) for loss in (0.6, 0.8)},
    **{f"{n} frames missing": Row(PAN, changed({"drops": [{"at": 1000, "frames": n}]})) for n in (20, 50, 200)},
    "jump of 60 px behind black frames": Row(
        PAN,
        changed({"objects": [{"size": [2, 2], "flux": 0, "first": 800, "frames": 450}], "drops": [{"at": 825, "frames": 400}]}),
    ),
    "50 frames doubled": Row(PAN, changed({"repeats": [{"at": at, "frames": 50} for at in (600, 1400)]})),
    "every tenth frame doubled": Row(PAN, changed({"repeats": [{"at": at} for at in range(5, 2000, 10)]})),
    **{
        f"moving object over {share:.0%}": Row(PAN, partial(moving, share))  # the size comes last
        for share in (0.15, 0.3, 0.5, 0.6, 0.7)
    },
    "object that crosses the frame": Row(PAN, crossing),
    "light that falls to an eighth": Row(PAN, changed({"drift": 0.125})),
    "two layers with parallax": Row(
        PAN,
        changed({"objects": [{"size": [4, 0.5], "at": [0.5, 0.75], "follows": 1.5, "seed": 1}]}),
        spec={"resample": {"with": {"group_size": 50}}},
    ),
    "lens k1 -0.2%": Row(PAN, changed({"lens": {"k1": -0.002}})),
    "lens k1 0.5%": Row(PAN, changed({"lens": {"k1": 0.005}})),
    **{f"window over {share:.0%}, dim": Row(PAN, changed(standing(share) | {"flux": 0.05})) for share in (0.3, 0.6)},
    **{
        name: Row(PAN, way=way)
        for name, way in {
            "acceleration to the end": accelerating,
            "jerks of 8 px": jerking,
            "kicks at the ends": kicked_at_its_ends,
            "taps": tapped,
            "sudden stop": stopping,
        }.items()
    },
    "jerks of 8 px, flux 0.05": Row(PAN, changed({"flux": 0.05}), way=jerking),
    "kicks at the ends, flux 0.05": Row(PAN, changed({"flux": 0.05}), way=kicked_at_its_ends),
    "kicks at the ends, until converged": Row(PAN, spec={"levels": "until-converged"}, way=kicked_at_its_ends),
    "ends without texture": Row(PAN, picture=bounded),
    "ends without texture, until converged": Row(PAN, spec={"levels": "until-converged"}, picture=bounded),
    "horizon": Row(PAN, lambda size: shaken(size, PAN, 1, (25, 120, 400)), picture=horizon),
    **{
        f"sine every {period} frames, flux 0.1": Row(PAN, changed({"n_frames": 4000, "flux": 0.1}), way=partial(sine, period))
        for period in (2, 5, 12, 30, 100, 300, 2000)
    },
    **{f"frames out of order within {within}": Row(PAN, order=partial(shuffled, within)) for within in (8, 16)},
    "frames in any order": Row(PAN, order=partial(shuffled, 10**6)),
    "frames in reverse": Row(PAN, order=lambda n_frames: np.arange(n_frames)[::-1]),
    "every frame doubled": Row(PAN, order=lambda n_frames: np.arange(n_frames) // 2),
    **{
        f"first {n_frames} frames": Row(PAN, order=lambda _, n_frames=n_frames: np.arange(n_frames))
        for n_frames in (20, 60, 200)
    },
    "drops of 6 frames": Row(PAN, changed({"drops": [{"at": at, "frames": 6} for at in range(100, 1900, 180)]})),
    "afterpulsing of 30 %": Row(PAN, changed({"sensor": {"afterpulsing": 0.3}})),
    "crosstalk of 20 %, dead time": Row(PAN, changed({"sensor": {"crosstalk": 0.2, "dead_time": 0.3}})),
    "gradient of sensitivity": Row(PAN, changed({"sensor": {"dirt": {"specks": 1, "radius_px": 150, "loss": 0.6}}})),
    "lamp over all, 100 Hz": Row(PAN, changed({"lamps": [{"depth": 0.9}]})),
    "lamp over all, 2 kHz": Row(PAN, changed({"lamps": [{"depth": 0.5, "frequency_hz": 2000}]})),
    "lamps over parts of the scene": Row(
        PAN,
        changed(
            {"lamps": [{"depth": 0.9, "frequency_hz": 1000, "at": [at, 0.5], "phase_deg": 120 * at} for at in (0.45, 0.6)]}
        ),
    ),
    "night, flux 0.3": Row(PAN, changed({"scene": {"kind": "night"}, "flux": 0.3})),
    "night, flux 0.05": Row(PAN, changed({"scene": {"kind": "night"}, "flux": 0.05})),
    "half black, flux 0.05": Row(PAN, changed({"flux": 0.05}), picture=half_black),
    "turn of 40 degrees": Row(PAN, changed({"focal_length_px": 400})),
    "turn through a wide lens": Row(PAN, changed({"focal_length_px": 150, "distortion": {"k1": -0.1, "k2": 0.03}})),
    **{
        f"travel of {way:g} m past clutter": Row(
            PAN,
            lambda size, way=way: {
                "path": {**bases(size)[PAN]["path"], "travel_m": [way, 0, 0]},
                "clutter": {"share": 0.2},
                "focal_length_px": 500,
            },
        )
        for way in (0.02, 0.2)
    },
    "people over 20 %": Row(PAN, changed({"people": {"share": 0.2}, "focal_length_px": 500})),
    "closed shutter": Row(PAN, changed({"shutter": [[0.3, 0.34], [0.7, 0.74]]})),
    **{
        f"half of the scene nearer by {nearer:.0%}": Row(
            PAN, changed({"objects": [{"size": [4, 0.5], "at": [0.5, 0.75], "follows": 1 + nearer, "seed": 1}]})
        )
        for nearer in (0.02, 0.05, 0.2)
    },
    "panels that repeat": Row(LONG, lambda size: shaken(size, LONG, 0.5, (60, 223, 590, 1270)) | {"flux": 0.2}, picture=panels),
    "checkerboard": Row(PAN, picture=checkerboard),
    "stripes": Row(PAN, picture=stripes),
    "unpacked zeros and ones": Row(PAN, repack=lambda packed, width: np.unpackbits(packed, axis=-1, count=width)),
    "lowest bit first": Row(
        PAN, repack=lambda packed, _: np.packbits(np.unpackbits(packed, axis=-1), axis=-1, bitorder="little")
    ),
    "packed along the height": Row(
        PAN, repack=lambda packed, width: np.packbits(np.unpackbits(packed, axis=-1, count=width), axis=1)
    ),
}


def before_photographs(files: Sequence[Path], size: Size) -> dict[str, Row]:
    """Return the rows, those of the street before these photographs in turn; and the benign ones before all of them."""
    if not files:
        return ROWS
    rows = {
        name: row
        if row.picture or "scene" in row.changes(size)
        else replace(row, picture=partial(photograph, files[number % len(files)], size))
        for number, (name, row) in enumerate(ROWS.items())
    }
    benign = (PAN, LONG, "clean, flux 0.02", "tremor of 1 px")
    return rows | {
        f"{file.stem}: {name}": replace(ROWS[name], picture=partial(photograph, file, size))
        for file in files
        for name in benign
    }


SPLINE = "clean, flux 0.5"
RASTER = {"path": {"kind": "scan", "rows": 3, "row_spacing_px": 24, "length_px": 480}}
TREMOR = {**shaken(TINY, SPLINE, 1, (223, 590, 1270)), "flux": 0.2}


def missing(frames: int, *at: int) -> Settings:
    """Return gaps of so many frames."""
    return {"drops": [{"at": each, "frames": frames} for each in at]}


CUT_ROWS: dict[str, Row] = {
    **{f"clean, flux {flux}": Row(f"clean, flux {flux}") for flux in (0.5, 0.1, 0.02)},
    "clean, fast turns": Row(SPLINE, changed({"path": {"kind": "random-spline", "length_px": 900, "knots": 12}})),
    "clean raster": Row(SPLINE, changed(RASTER)),
    "clean, tremor of 1 px": Row(SPLINE, changed(TREMOR)),
    "clean, vibration of 3 px": Row(SPLINE, changed(shaken(TINY, SPLINE, 3, (1000,)))),
    "clean, strong shake": Row(SPLINE, changed(shaken(TINY, SPLINE, 10, (25, 90, 210)))),
    **{
        f"clean, tremor of {frequency} Hz": Row(SPLINE, changed(shaken(TINY, SPLINE, 2, (frequency,)) | {"flux": 0.2}))
        for frequency in (25, 100, 400, 2000)
    },
    "clean, light that falls to a thirtieth": Row(SPLINE, changed({"drift": 0.03})),
    "clean, ends without texture": Row(PAN, changed({"path": {"kind": "pan", "length_px": 250}}), picture=bounded),
    "clean, horizon": Row(PAN, changed(shaken(TINY, PAN, 1, (25, 120, 400))), picture=horizon),
    "20 frames missing": Row(SPLINE, changed(missing(20, 700))),
    "60 frames missing, flux 0.02": Row("clean, flux 0.02", changed(missing(60, 700))),
    "60 frames missing, flux 0.1": Row("clean, flux 0.1", changed(missing(60, 700))),
    "60 frames missing twice, tremor": Row(SPLINE, changed(TREMOR | missing(60, 500, 1000))),
    "50 frames doubled": Row(SPLINE, changed({"repeats": [{"at": 700, "frames": 50}]})),
}
"""Captures of `TINY`, with and without jumps, on which cuts are counted."""
