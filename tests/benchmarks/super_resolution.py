"""Measure super-resolution along the estimated motion, by default at twice the resolution of the sensor.

    python tests/benchmarks/super_resolution.py facade.jpg stream.jpg [--flux 0.5] [--scale 3 --fill-factor 0.105]

For each scene and flux, 10,000 frames of 128x160 px are simulated, whose pixels average the scene over their areas. A run
estimates the motion and renders at `--scale`. Scores are PSNR in dB, in sRGB, against the true scene, over the same
pixels. Compared are:

- bicubic: the panorama of scale 1 along the same motion, interpolated;
- Richardson-Lucy: the merge of the same scale, deconvolved with the area of a pixel, with as many steps as fit the truth best;
- true motion: super-resolution along the true motion;
- thin: super-resolution and bicubic where at most a fifth as many frames as usual saw a pixel.

`--large` measures the time and the memory of a canvas of 2,048x1,365 px at scale 2 instead.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from harness import (
    Compared,
    Study,
    command,
    in_child,
    packed,
    passing,
    record_of,
    scores_of,
    simulator,
    table,
    to_reference,
    took,
)  # fmt: skip
from numpy.typing import NDArray

from photonpano import open_source, parse_spec
from photonpano.capture.writing import truth_path
from photonpano.evaluation import covered, load_truth
from photonpano.execution.context import Context
from photonpano.geometry import FrameTrajectory
from photonpano.merging.panorama import plan_canvas, render
from photonpano.pipeline.rendering import build_renderer
from photonpano.record.run_json import peak_memory_bytes

FLUXES = (0.5, 0.1, 0.02)
THREADS = 2
STEPS = 60  # steps of Richardson-Lucy, of which the best is taken
THIN = 0.2
HEAD = (
    "scene", "flux", "motion px", "bicubic", "Richardson-Lucy", "super-resolution", "true motion", "thin: bicubic", "thin",
    "rounds",
)  # fmt: skip


def simulated(study: Study, scene: Path, flux: float, frames: int, seed: int, width: int = 1200, **keys: Any) -> Path:
    """Simulate a capture; its truth lies beside it."""
    camera = {
        "scene": {"kind": "photo", "file": str(scene), "width": width},
        "scene_scale": 2,
        "path": {"kind": "loop", "length_px": 160.0, "shake": {"rms_px": 0.6, "roll_rms_deg": 0.02}},
        "flux": flux,
        "n_frames": frames,
        "frame_shape": [128, 160],
        "seed": seed,
    }
    return study.capture("capture", simulator(**camera | keys))


def row(scene: Path, flux: float, frames: int, seed: int, scale: int, fill_factor: float) -> Sequence[str]:
    """Measure a scene at a flux: return the cells of a row."""
    with passing() as study:
        keys = {"scene_scale": scale, "fill_factor": fill_factor}
        capture = simulated(study, scene, flux, frames, seed, 600 * scale, **keys)
        renderer = {"use": "super-resolution", "with": {"fill_factor": fill_factor}, "scale": float(scale)}
        run = Compared.of(study.run("run", packed(capture, render=renderer)), capture)
        scores, canvas, panorama = scores_of(run.folder, capture), run.canvas, run.panorama
        true_image = run.scene(canvas)
        fine, bicubic = run.finer()
        usual = covered(panorama.weight) & covered(fine.weight) & np.isfinite(true_image)
        usual = cv2.erode(usual.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
        thin = usual & (panorama.weight < THIN * np.median(panorama.weight[usual]))

        def psnr(image: NDArray[np.float32], where: NDArray[np.bool_] = usual) -> float:
            return run.psnr_db(image, true_image, where) if where.any() else float("nan")

        deconvolved = richardson_lucy(np.nan_to_num(fine.flux), scale * fill_factor**0.5, psnr)
        decided = {each["what"]: each["value"] for each in record_of(run.folder)["decisions"]}
        assert scores.below_oracle_db is not None
        reached = psnr(panorama.flux)
        head = f"{psnr(bicubic):.1f}", f"{deconvolved:.1f}", f"**{reached:.1f}**", f"{reached + scores.below_oracle_db:.1f}"
        where_thin = (f"{psnr(image, thin):.1f}" for image in (bicubic, panorama.flux))
        rounds = f"{decided['super_resolution.rounds']}"
        return scene.stem, f"{flux:g}", f"{run.score.mean_px:.3f}", *head, *where_thin, rounds


def richardson_lucy(image: np.ndarray, width: float, score: Callable[[np.ndarray], float]) -> float:
    """Deconvolve a merge with the area of a pixel, of a width in px of the merge, and return the best score of all steps."""
    offsets = np.arange(-2, 3)
    shares = np.maximum(np.minimum(offsets + 0.5, width / 2) - np.maximum(offsets - 0.5, -width / 2), 0) / width
    kernel = np.outer(shares, shares).astype(np.float32)
    best, estimate = -np.inf, image.astype(np.float32) + 1e-6
    for _ in range(STEPS):
        seen = cv2.filter2D(estimate, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
        ratio = cv2.filter2D(image / np.maximum(seen, 1e-6), cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE)
        estimate = estimate * ratio
        best = max(best, score(estimate))
    return float(best)


def large_canvas(scene: Path, frames: int, seed: int) -> str:
    """Measure the time and the memory of rendering a canvas of about 2,048x1,365 px along the true motion."""
    with passing() as study:
        path = {"kind": "scan", "length_px": 3560.0, "rows": 6, "row_spacing_px": 85.0}
        capture = simulated(study, scene, 0.5, frames, seed, 2200, frame_shape=[254, 496], path=path)
        return in_child(fine_rendered, capture).result


def fine_rendered(capture: Path) -> str:
    """Render a capture along the true motion, and return what that takes in this process."""
    plan = parse_spec(packed(capture, render={"use": "super-resolution", "scale": 2.0}))
    with open_source(plan) as source:
        trajectory = FrameTrajectory(to_reference(load_truth(truth_path(capture)).homographies))
        renderer, span = build_renderer(plan, source, []), source.info.span
        canvas = plan_canvas(trajectory, span, source.info.frame_shape, 2.0, 2**31)
        before = peak_memory_bytes()
        _, seconds, worked, peak_mib = took(render, source, trajectory, span, canvas, 0.125, Context(threads=THREADS), renderer)
    each = (peak_mib * 2**20 - before) / (canvas.width * canvas.height)
    return (
        f"{canvas.width}x{canvas.height} px from {source.info.n_frames} frames: {seconds:.0f} s, {worked:.0f} s of processor "
        f"time, peak memory {peak_mib / 2**10:.2f} GiB, {each:.0f} bytes per pixel"
    )


def main(
    *scenes: Path,
    flux: Sequence[float] = FLUXES,
    frames: int = 10_000,
    seed: int = 1,
    scale: int = 2,
    fill_factor: float = 1.0,
    large: bool = False,
) -> None:
    """Print the table for photographs; or what a large canvas takes."""
    scenes = tuple(scene.resolve() for scene in scenes)
    if large:
        print(*(large_canvas(scene, frames, seed) for scene in scenes), sep="\n")
    else:
        table(HEAD, (row(scene, each, frames, seed, scale, fill_factor) for scene in scenes for each in flux))


if __name__ == "__main__":
    command(main)
