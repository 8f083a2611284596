"""Measure what limits colour behind a Bayer array, photons or blur: a table of docs/explanation/limits.md.

    python tests/benchmarks/colour_limits.py PHOTOGRAPH [--flux F ...] [--frames N]

Simulates frames of 128x192 px, and the same frames without noise, and renders both along the true motion:

- merged: each colour alone;
- photonpano: with the detail that colours share;
- demosaicked: groups demosaicked by OpenCV's edge-aware method, and averaged;
- three sensors: one for each colour without filters, with as many photons as its coloured pixels get;
- three sensors, shared: the same, with the detail that colours share.

Prints the PSNR in dB of each, that of the image without noise, that of its noise alone, and the best that the image reaches
when it is smoothed by a Gaussian, with the width of that Gaussian: a comparison in which no method gains by blur.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from colour import Camera, demosaicked

from photonpano import FrameSpan, StreamInfo, open_source, parse_spec
from photonpano.context import Context
from photonpano.corrections.colour_filter import with_colours
from photonpano.evaluation import covered, image_score, true_panorama, white_flux
from photonpano.geometry import Canvas, FrameTrajectory, canvas_of, inverse, normalised
from photonpano.merging.colour import composed, filled, with_shared_detail
from photonpano.merging.panorama import render
from photonpano.photometry import BinaryResponse, linear_to_srgb
from photonpano.reading import bayer_array
from photonpano.testing import MemorySource

SHARE = np.array([0.25, 0.5, 0.25], np.float32)
"""Of the pixels of a Bayer array that are red, green and blue."""
BLURS_PX = (0.0, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5, 2.0)


class Expected(MemorySource):
    """Probabilities in place of photons: frames without noise."""

    def __init__(self, chances: np.ndarray) -> None:
        super().__init__(np.zeros((1, 1, 1)))
        self.chances = chances
        self.info = StreamInfo(*chances.shape, frame_rate_hz=None)
        self.valid = np.ones(chances.shape[1:], np.bool_)

    def counts(self, span: FrameSpan) -> Any:
        """Sum the probabilities of a span."""
        return self.chances[span.start : span.stop].sum(axis=0, dtype=np.float32)


def chances_of(scene: np.ndarray, motion: np.ndarray, places: np.ndarray) -> list[np.ndarray]:
    """Return the probability that each pixel is lit behind the array, and on each of three sensors: (T, H, W) each."""
    chances = [np.empty((len(motion), *places.shape), np.float32) for _ in range(4)]
    for index, homography in enumerate(motion):
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        seen = cv2.warpPerspective(scene, homography, places.shape[::-1], flags=flags)
        lights = [np.take_along_axis(seen, places[..., None].astype(int), axis=-1)[..., 0], *np.moveaxis(SHARE * seen, -1, 0)]
        for chance, light in zip(chances, lights, strict=True):
            chance[index] = -np.expm1(-light)
    return chances


def images_of(cubes: list[Any], sources: list[Any], places: np.ndarray, motion: FrameTrajectory, canvas: Canvas) -> Any:
    """Return the images by name, and the number of frames that saw each pixel in each colour."""
    span = FrameSpan(0, len(cubes[0]))
    bayer = with_colours(sources[0], places.astype(np.int8))
    raw = render(bayer, motion, span, canvas, 0.125, Context(2))
    single = [render(each, motion, span, canvas, 0.125, Context(2)).flux for each in sources[1:]]
    three = np.stack(single, axis=-1) / SHARE
    frames = raw.weight.sum(axis=-1, keepdims=True) * SHARE
    images = {
        "merged": filled(raw.flux, raw.weight),
        "photonpano": composed(raw, bayer).flux,
        "demosaicked": demosaicked(cubes[0], places, motion, canvas),
        "three sensors": three,
        "three sensors, shared": with_shared_detail(np.nan_to_num(three), frames, BinaryResponse()),
    }
    return images, raw.weight


def measured(photograph: Path, camera: Camera, seed: int) -> None:
    """Print the rows of one capture."""
    scene = {"kind": "photo", "file": str(photograph), "width": camera.width}
    simulator = {"scene": scene, "flux": camera.flux, "sensor": {"filters": "rggb"}, **camera.settings(seed)}
    with open_source(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}})) as source:
        truth: Any = source.truth()
    places, rng = bayer_array("rggb", camera.shape), np.random.default_rng(seed + 1)
    at_reference = truth["homographies"][camera.n_frames // 2]
    to_reference = normalised(inverse(at_reference) @ truth["homographies"])
    canvas, motion = canvas_of(to_reference, camera.shape, 1.0), FrameTrajectory(to_reference)
    chances = chances_of(truth["scene"], truth["homographies"], places)
    lit = [(rng.random(each.shape, np.float32) < each).astype(np.uint8) for each in chances]
    noisy, weight = images_of(lit, [MemorySource(each) for each in lit], places, motion, canvas)
    clean, _ = images_of(chances, [Expected(each) for each in chances], places, motion, canvas)
    expected = true_panorama(truth["scene"], canvas, at_reference)
    compared = covered(weight) & np.all([np.isfinite(each).all(axis=-1) for each in noisy.values()], axis=0)
    white = white_flux(truth["scene"])

    def score(image: np.ndarray, blur_px: float = 0.0) -> float:
        smooth = cv2.GaussianBlur(np.nan_to_num(image), (0, 0), blur_px) if blur_px else image
        return image_score(smooth, expected, compared, white).psnr_db

    for name, image in noisy.items():
        difference = linear_to_srgb(image[compared] / white) - linear_to_srgb(clean[name][compared] / white)
        noise_db = -10 * np.log10(np.square(difference, dtype=np.float64).mean())
        best_db, blur_px = max((score(image, blur_px), blur_px) for blur_px in BLURS_PX)
        values = [f"{each:.1f}" for each in (score(image), score(clean[name]), noise_db, best_db, blur_px)]
        head = [photograph.stem, f"{camera.flux:g}", f"{weight[compared].sum(axis=-1).mean():.0f}", name]
        print("| " + " | ".join([*head, *values]) + " |", flush=True)


def main() -> None:
    """Print a table for each photograph and flux."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path, nargs="+")
    parser.add_argument("--flux", type=float, nargs="+", default=[0.5, 0.1, 0.02])
    parser.add_argument("--frames", type=int, default=Camera.n_frames)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print("| scene | flux | frames | image | PSNR | without noise | noise alone | smoothed | by (px) |")
    for photograph in given.photographs:
        for flux in given.flux:
            measured(photograph.resolve(), Camera(n_frames=given.frames, flux=flux), given.seed)


if __name__ == "__main__":
    main()
