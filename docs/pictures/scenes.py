"""Scenes of the simulators: a night with each tone, and those that a camera travels through with their depth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, get_args

import cv2
import numpy as np
from picture_parts import beside, labelled, picture, stacked

from photonpano import open_source, parse_spec
from photonpano.photometry import BinaryResponse, Tone, picture_of
from photonpano_simulator.config import NightScene
from photonpano_simulator.scenes import scene_flux
from photonpano_simulator.travel.truth import depth, sharp_view, truth_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

NIGHT_FLUX = 12.0
"""Flux of the brightest lamp in the night scene, photons per pixel per frame."""
NIGHT_FRAMES = 100_000


def pictures(_: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    yield "night.png", night()
    yield "depth.png", depths()


def night() -> Picture:
    """Show a night scene of 120 dB, as 100,000 frames of a still camera measure it, with each tone."""
    scene = scene_flux(NightScene(width=520, height=346), 1.0)
    scene *= NIGHT_FLUX / scene.max()
    lit = np.random.default_rng(0).binomial(NIGHT_FRAMES, -np.expm1(-scene.astype(float)))
    weight = np.full(scene.shape, NIGHT_FRAMES, np.float32)
    response = BinaryResponse()
    flux = response.debiased(response.flux((lit / NIGHT_FRAMES).astype(np.float32), weight), weight)
    white = float(np.quantile(flux, 0.995))
    shown = [labelled(picture_of(flux, white, tone, 0.5 if tone == "local" else 0.0), tone) for tone in get_args(Tone)]
    shown.append(np.full_like(shown[0], 255))
    return stacked([beside(shown[first : first + 2]) for first in range(0, len(shown), 2)])


def depths() -> Picture:
    """Show the scenes of `travel-simulator`: a frame without noise, 500 binary frames of it, and its depth."""
    rows = []
    for kind in ("room", "facade", "planes"):
        camera = {"scene": {"kind": kind}, "path": {"kind": "turn-only", "degrees": 0}, "n_frames": 500}
        with open_source(parse_spec({"version": 1, "source": {"use": "travel-simulator", "with": camera}})) as source:
            truth, info = truth_of(source.truth()), source.info
            sharp, photons = (
                sharp_view(truth, 0),
                source.response.flux(source.counts(info.span) / np.float32(info.n_frames), 500),
            )
        white = float(np.quantile(sharp, 0.995))
        near = 1 / depth(truth, 0)
        far, nearest = np.quantile(near, (0.0, 1.0))
        levels = (40 + 200 * (near - far) / (nearest - far)).astype(np.uint8)
        labels = (kind, "500 frames, 0.3 photons a frame", f"depth: {1 / nearest:.1f} m (light) to {1 / far:.1f} m (dark)")
        shown = (picture(sharp, white), picture(photons, white), levels)
        rows.append(
            beside(
                [
                    labelled(cv2.resize(each, (330, 169), interpolation=cv2.INTER_AREA), label)
                    for each, label in zip(shown, labels, strict=True)
                ]
            )
        )
    return stacked(rows)
