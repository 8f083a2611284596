"""A camera in three channels that trembles: its last frame, the mean of the last frames, and the picture of one instant."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import picture_parts as draw
import tifffile
from harness import Study, packed
from numpy.typing import NDArray

from photonpano.photometry import BinaryResponse, picture_of
from photonpano.testing.captures import detected, seen_along
from photonpano_simulator.config import StreetScene
from photonpano_simulator.scenes import scene_flux

SHAPE, N_FRAMES, FLUX, WAY_PX, TREMOR_PX = (240, 280), 1024, 0.9, 80.0, 3.0
MARGIN = 60
"""Pixels of the scene around what the camera sees."""
LENGTHS = (4, 8, 16, 32, 64, 128)
"""Numbers of last frames that are averaged; the picture shows the best."""


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield the picture with its name, and print its scores."""
    cube, homographies, scene = capture(study.folder / "instant.npy")
    truth = np.stack([seen_along(each, homographies[-1], SHAPE)[0] for each in np.moveaxis(scene, -1, 0)], axis=-1)
    run = study.run("instant", packed(cube, render={"reference": "last", "extent": "reference"}))
    white = float(np.quantile(truth, 0.999))
    last = np.unpackbits(np.load(cube, mmap_mode="r")[-max(LENGTHS) :], axis=2, count=SHAPE[1])
    means = {n: BinaryResponse().flux(last[-n:].mean(axis=0, dtype=np.float32), n) for n in LENGTHS}
    instant = tifffile.imread(run / "panorama.tiff")
    scores = {f"last {n} frames": psnr_db(flux, truth, white) for n, flux in means.items()}
    best = max(means, key=lambda n: scores[f"last {n} frames"])
    scores["one instant"] = psnr_db(instant, truth, white)
    print("; ".join(f"{name}: {score:.1f} dB" for name, score in scores.items()))
    flux = last[-1] * white, means[best], instant, truth
    tones = [picture_of(np.asarray(each, np.float32), white, "srgb", 0)[..., ::-1] for each in flux]
    names = "the last frame", f"mean of the last {best}", "one instant", "the true image"
    yield "one-instant.png", draw.beside(draw.all_labelled(dict(zip(names, tones, strict=True))))


def capture(path: Path) -> tuple[Path, NDArray[np.float64], NDArray[np.float32]]:
    """Simulate a capture unless it is there: return its path, the homographies of its frames and the scene, (H, W, 3)."""
    height, width = SHAPE
    street = StreetScene(width=width + 2 * MARGIN + int(WAY_PX), height=height + 2 * MARGIN)
    scene = scene_flux(street, FLUX, in_colour=True)
    rng, time = np.random.default_rng(0), np.arange(N_FRAMES) / N_FRAMES
    x, y = (TREMOR_PX * np.convolve(each, np.ones(31) / np.sqrt(31), "same") for each in rng.normal(size=(2, N_FRAMES)))
    homographies = np.tile(np.eye(3), (N_FRAMES, 1, 1))
    homographies[:, 0, 2], homographies[:, 1, 2] = MARGIN + WAY_PX * time + x, MARGIN + 12 * np.sin(5 * time) + y
    if not path.exists():
        frames = [np.stack([seen_along(each, at, SHAPE)[0] for each in np.moveaxis(scene, -1, 0)], -1) for at in homographies]
        np.save(path, np.packbits([detected(each, rng) for each in frames], axis=2))
    return path, homographies, scene


def psnr_db(flux: NDArray[np.float32], truth: NDArray[np.float32], white: float) -> float:
    """Return the peak signal-to-noise ratio of the sRGB pictures of two images of flux."""
    first, second = (picture_of(np.asarray(each, np.float32), white, "srgb", 0).astype(float) for each in (flux, truth))
    return float(10 * np.log10(255**2 / np.mean((first - second) ** 2)))
