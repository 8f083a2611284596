"""Kinds of captures that are hard to run, each with a known truth; `trust.py` runs them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
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
TINY = Size((96, 144), (1600, 240.0))  # of captures for cuts


@dataclass(frozen=True)
class Row:
    """A kind of capture.

    Attributes:
        base: name of the undisturbed capture, of `bases`.
        changes: of the size of frames, what else the simulator is told.
        spec: sections of the run's spec, where they are not the defaults.
        picture: paints the scene with a seed, where it is not the street: uint8 or uint16.
        repack: writes the frames of a packed capture as somebody else might have.
    """

    base: str
    changes: Callable[[Size], Settings] = lambda _: {}
    spec: Settings = field(default_factory=dict)
    picture: Callable[[int], np.ndarray] | None = None
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
