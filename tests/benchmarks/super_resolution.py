"""Measure super-resolution along the estimated motion, by default at twice the resolution of the sensor.

    python tests/benchmarks/super_resolution.py --scene facade.jpg --scene stream.jpg --output table.md

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

import argparse
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from photonpano import parse_spec, run, simulate
from photonpano.api.evaluate import evaluate
from photonpano.context import Context
from photonpano.evaluation.images import covered, image_score, true_panorama, white_flux
from photonpano.evaluation.inputs import load_panorama, load_run_trajectory, load_truth
from photonpano.evaluation.trajectory import corner_errors
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.merging.canvas_plan import plan_canvas
from photonpano.merging.panorama import render
from photonpano.pipeline.components import open_source

FLUXES = (0.5, 0.1, 0.02)
THREADS = 2
STEPS = 60
"""Steps of Richardson-Lucy, of which the best is taken."""
THIN = 0.2
HEAD = (
    "| scene | flux | motion px | bicubic | Richardson-Lucy | super-resolution | true motion | thin: bicubic | thin | rounds |"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", action="append", type=Path, required=True, help="a photograph; give several")
    parser.add_argument("--flux", action="append", type=float, help="photons per pixel per frame; by default 0.5, 0.1 and 0.02")
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scale", type=int, default=2, help="pixels of the panorama along the side of a pixel")
    parser.add_argument("--fill-factor", type=float, default=1.0, help="sensitive share of the area of a pixel")
    parser.add_argument("--large", action="store_true", help="measure time and memory of a large canvas")
    parser.add_argument("--output", type=Path, help="write the table to this file")
    options = parser.parse_args()
    lines = [HEAD, "|" + " --- |" * (HEAD.count("|") - 1)]
    for scene in options.scene:
        if options.large:
            print(large(scene, options.frames, options.seed), flush=True)
            continue
        for flux in options.flux or FLUXES:
            lines.append(row(scene, flux, options.frames, options.seed, options.scale, options.fill_factor))
            print(lines[-1], flush=True)
    if options.output:
        options.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def simulated(folder: Path, scene: Path, flux: float, frames: int, seed: int, width: int = 1200, **keys: Any) -> Path:
    """Simulate a capture; its truth lies beside it."""
    capture = folder / "capture.npy"
    simulator = {
        "scene": {"kind": "photo", "file": str(scene), "width": width},
        "scene_scale": 2,
        "path": {"kind": "loop", "length_px": 160.0, "shake": {"rms_px": 0.6, "roll_rms_deg": 0.02}},
        "flux": flux,
        "n_frames": frames,
        "frame_shape": [128, 160],
        "seed": seed,
    }
    simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator | keys}}), capture)
    return capture


def spec_of(capture: Path, **sections: Any) -> dict[str, Any]:
    source = {"use": "packed-npy", "with": {"path": str(capture), "frame_rate_hz": 96_800.0}}
    return {"version": 1, "source": source, "render": {"use": "super-resolution", "scale": 2.0}} | sections


def row(scene: Path, flux: float, frames: int, seed: int, scale: int = 2, fill_factor: float = 1.0) -> str:
    """Measure a scene at a flux."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        keys = {"scene_scale": scale, "fill_factor": fill_factor}
        capture = simulated(folder, scene, flux, frames, seed, 600 * scale, **keys)
        rendering = {"use": "super-resolution", "with": {"fill_factor": fill_factor}, "scale": float(scale)}
        plan = parse_spec(spec_of(capture, render=rendering), output=folder / "run")
        record = run(plan).record
        scores = evaluate(folder / "run", capture.with_name("capture.truth.npz"))
        truth, found = load_truth(capture.with_name("capture.truth.npz")), load_run_trajectory(folder / "run")
        flux_image, weight = load_panorama(folder / "run")
        canvas = Canvas(*flux_image.shape[:2], found.canvas)
        motion = corner_errors(found.homographies, truth.homographies, found.frame_shape, found.located)
        assert truth.scene is not None
        white, true_image = white_flux(truth.scene), true_panorama(truth.scene, canvas, motion.alignment)
        with open_source(plan) as source:
            trajectory, span = FrameTrajectory(found.homographies), source.info.span
            small = plan_canvas(trajectory, span, source.info.frame_shape, 1.0, 2**31)
            merged = render(source, trajectory, span, small, 0.125, Context(2))
            fine = render(source, trajectory, span, canvas, 0.125, Context(2))
        to_small = small.transform @ np.linalg.inv(canvas.transform)
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        size = canvas.width, canvas.height
        bicubic = cv2.warpPerspective(np.nan_to_num(merged.flux), to_small, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        usual = covered(weight) & covered(fine.weight) & np.isfinite(true_image)
        usual = cv2.erode(usual.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
        thin = usual & (weight < THIN * np.median(weight[usual]))

        def psnr(image: np.ndarray, where: np.ndarray = usual) -> float:
            return image_score(image, true_image, where, white).psnr_db if where.any() else float("nan")

        deconvolved = richardson_lucy(np.nan_to_num(fine.flux), scale * fill_factor**0.5, psnr)
        decided = {each["what"]: each["value"] for each in record["decisions"]}
        assert scores.oracle is not None
        assert scores.panorama is not None
        along_truth = psnr(flux_image) + scores.oracle.psnr_db - scores.panorama.psnr_db
        cells = [
            scene.stem,
            f"{flux:g}",
            f"{motion.mean_px:.3f}",
            f"{psnr(bicubic):.1f}",
            f"{deconvolved:.1f}",
            f"**{psnr(flux_image):.1f}**",
            f"{along_truth:.1f}",
            f"{psnr(bicubic, thin):.1f}",
            f"{psnr(flux_image, thin):.1f}",
            f"{decided['super_resolution.rounds']}",
        ]
        return f"| {' | '.join(cells)} |"


def richardson_lucy(image: np.ndarray, width: float, score: Any) -> float:
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


def large(scene: Path, frames: int, seed: int) -> str:
    """Measure the time and the memory of rendering a canvas of about 2,048x1,365 px along the true motion."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = {"kind": "scan", "length_px": 3560.0, "rows": 6, "row_spacing_px": 85.0}
        keys = {"frame_shape": [254, 496], "path": path}
        # A process of its own: its memory does not count.
        with ProcessPoolExecutor(1) as pool:
            capture = pool.submit(simulated, folder, scene, 0.5, frames, seed, 2200, **keys).result()
        truth = load_truth(capture.with_name("capture.truth.npz"))
        plan = parse_spec(spec_of(capture), output=folder / "run")
        from photonpano.pipeline.rendering import build_renderer

        with open_source(plan) as source:
            middle = len(truth.homographies) // 2
            motion = np.linalg.inv(truth.homographies[middle]) @ truth.homographies
            trajectory = FrameTrajectory(motion / motion[:, 2:, 2:])
            renderer = build_renderer(plan, source, [])
            canvas = plan_canvas(trajectory, source.info.span, source.info.frame_shape, 2.0, 2**31)
            before = peak_memory()
            start, worked = time.perf_counter(), time.process_time()
            render(source, trajectory, source.info.span, canvas, 0.125, Context(THREADS), renderer)
            seconds, worked = time.perf_counter() - start, time.process_time() - worked
        each = (peak_memory() - before) / (canvas.width * canvas.height)
        return (
            f"{canvas.width}x{canvas.height} px from {frames} frames: {seconds:.0f} s, {worked:.0f} s of processor time, "
            f"peak memory {peak_memory() / 2**30:.2f} GiB, {each:.0f} bytes per pixel"
        )


def peak_memory() -> int:
    """Return the peak memory of this process so far, in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 2**10


if __name__ == "__main__":
    sys.exit(main())
