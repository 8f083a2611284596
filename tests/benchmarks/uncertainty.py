"""Measure how well panorama-std.tiff, the standard deviation of each pixel, says what the flux is off by.

    python tests/benchmarks/uncertainty.py docs/how-to/uncertainty.md

Simulates captures of 96x128 px, runs them with the defaults, and compares each panorama with one of frames without noise,
merged along the true motion: what is left is the error of photons and motion. It prints the root mean square of the error over
the standard deviation, which should be 1: where the scene is flat (the half of the pixels with the smallest gradient), textured
(the fifth with the largest), and at its sharpest edges (a twentieth).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from harness import (
    Compared,
    Expected,
    Study,
    chosen,
    command,
    passing,
    record_of,
    rendered,
    seen,
    simulator,
    table,
    write_tables,
)

from photonpano.geometry import FrameTrajectory, inverse

SHAPE = (96, 128)
STREET = {"kind": "street", "width": 1024, "height": 683}
SHAKING = {"kind": "random-spline", "length_px": 200, "shake": {"rms_px": 2.0, "frequencies_hz": [25, 120, 400]}}
PAN = {"kind": "pan", "length_px": 250}
CAPTURES: dict[str, dict[str, Any]] = {
    "pan": {"path": PAN, "flux": 0.3, "n_frames": 3000},
    "pan, 30,000 frames": {"path": PAN, "flux": 0.3, "n_frames": 30_000},
    "pan in the dark": {"path": PAN, "flux": 0.03, "n_frames": 3000},
    "trembling hand": {"path": SHAKING, "flux": 0.3, "n_frames": 5000},
    "trembling hand in the dark": {"path": SHAKING, "flux": 0.05, "n_frames": 5000},
    "trembling hand, bright": {"path": SHAKING, "flux": 2.0, "n_frames": 5000},
}
PARTS = {"flat": (0.0, 0.5), "textured": (0.8, 1.0), "sharpest": (0.95, 1.0)}
"""Quantiles of the gradient between which the pixels of a part lie."""
SEEN = 0.3  # share of the largest coverage below which pixels are not compared


def ratios(study: Study, name: str, camera: dict[str, Any]) -> Iterator[object]:
    """Return the cells of a row: capture, verdict, error and expected error of the motion, and the ratio of each part."""
    spec = simulator(scene=STREET, frame_shape=list(SHAPE), **camera)
    capture = study.capture(name, spec)
    run = Compared.of(study.run(name, spec, capture), capture)
    flux, std, canvas = run.panorama.flux, tifffile.imread(run.folder / "panorama-std.tiff"), run.canvas
    true = run.truth.homographies
    with run.source() as source:
        scene = run.truth.scene
        without_noise = Expected(source, lambda index: -np.expm1(-seen(scene, true[index], SHAPE).astype(np.float64)))
        clean = rendered(without_noise, FrameTrajectory(inverse(run.score.alignment) @ true), canvas)
    # Of frames without noise, half a dark frame more is a bias.
    weight = np.maximum(clean.weight.astype(np.float64), 1)
    chance = -np.expm1(-clean.flux.astype(np.float64)) * (weight + 0.5) / weight
    exact = -np.log1p(-np.minimum(chance, 1 - 1e-9))
    steepness = np.hypot(*np.gradient(exact))
    compared = np.isfinite(flux) & np.isfinite(steepness) & (run.panorama.weight > SEEN * run.panorama.weight.max())
    yield name
    yield record_of(run.folder)["verdict"]["status"]
    yield f"{run.score.mean_px:.3f}"
    yield f"{run.found.std_px[run.found.located].mean():.3f}"
    for low, high in PARTS.values():
        first, last = np.quantile(steepness[compared], (low, high))
        part = compared & (steepness >= first) & (steepness <= last)
        yield f"{np.sqrt(np.mean(((flux - exact) / std)[part] ** 2)):.2f}"


def main(page: Path | None = None, only: Sequence[str] = ()) -> None:
    """Measure all captures, or those whose names contain a word."""
    head = ["capture", "verdict", "error of the motion in px", "`std_px`", *PARTS]
    with passing() as study:
        rows = table(head, (ratios(study, name, CAPTURES[name]) for name in chosen(only, CAPTURES)))
    write_tables(page, {"uncertainty": rows})


if __name__ == "__main__":
    command(main, "uncertainty")
