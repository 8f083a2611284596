"""The scan of examples/pipelines: its panorama, what other specs make of it, and hot pixels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import tifffile
from picture_parts import beside, labelled, picture

from photonpano import load_spec

from .captures import EXAMPLES, done, finish, in_folder, written

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

WAYS = ("scan", "constant groups", "naive average")
"""Specs of examples/pipelines, for the capture beside them."""
PLACE = (235, 85)
"""Centre of the compared place, in pixels of the reference frame, which is the same for all specs."""


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    capture = written(load_spec(EXAMPLES / "capture.yaml"), folder / "capture.npy")
    for name in WAYS:
        path = EXAMPLES / f"{name.replace(' ', '-')}.yaml"
        overrides = [f"source.with.path={capture.absolute()}"]
        finish(load_spec(path, overrides=overrides, output=in_folder(folder, name)), name, capture)
    yield "first-panorama.png", picture(tifffile.imread(in_folder(folder, "scan") / "panorama.tiff"), 0.67)
    yield "baselines.png", baselines(folder)
    yield "hot-pixels.png", hot_pixels(folder)


def baselines(folder: Path) -> Picture:
    """Return the same place of the panoramas of several specs, magnified three times."""
    pictures = []
    for name in WAYS:
        file = f"{name.replace(' ', '-')}.yaml"
        flux = tifffile.imread(in_folder(folder, name) / "panorama.tiff")
        with np.load(in_folder(folder, name) / "trajectory.npz") as trajectory:
            x, y = (trajectory["canvas"] @ (*PLACE, 1))[:2].round().astype(int)
        crop = picture(flux[y - 54 : y + 54, x - 54 : x + 54], 0.67)
        pictures.append(labelled(cv2.resize(crop, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST).astype(np.uint8), file))
    return beside(pictures)


def hot_pixels(folder: Path) -> Picture:
    """Return a place of two panoramas of a sensor with hot pixels, magnified three times: uncorrected and corrected."""
    pictures = []
    for name, corrections in {"hot pixels": "[]", "hot pixels masked": "[hot-pixels]"}.items():
        overrides = [f"corrections={corrections}", "source.with.sensor.hot_rate=[0.5, 2]"]
        plan = load_spec(EXAMPLES / "hot-pixels.yaml", overrides=overrides, output=in_folder(folder, name))
        flux = tifffile.imread(done(plan) / "panorama.tiff")
        y, x = flux.shape[0] // 2, flux.shape[1] // 2
        crop = picture(flux[y - 54 : y + 54, x - 72 : x + 72], 0.67)
        large = cv2.resize(crop, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST).astype(np.uint8)
        pictures.append(labelled(large, f"corrections: {corrections}"))
    return beside(pictures)
