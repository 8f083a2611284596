"""Measure what each part of the method contributes to the accuracy: table and plot of docs/explanation/ablation.md.

    python tests/benchmarks/ablation.py docs/explanation/ablation.md

Every locator, graph and resampler runs on the same captures: the built-in street, a path of 360 px in 2,400 frames with tremor.
The last row of each flux is the Cramer-Rao bound. It takes some minutes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import matplotlib.pyplot as plt
import numpy as np
from pages import require_places, write_tables

from photonpano import PhotonpanoError, evaluate, parse_spec, run
from photonpano.evaluation import exposure_bound_px, load_truth
from photonpano.photometry import BinaryResponse

FLUXES = (0.5, 0.1, 0.02)
GROUP_SIZE = 250
LOCATORS: dict[str, dict[str, Any]] = {"opencv-sift": {"use": "opencv-sift"}, "direct": {"use": "direct"}}
GRAPHS: dict[str, dict[str, Any]] = {"chain": {"skips": [], "closure_overlap": None}, "full": {}}
RESAMPLERS = {"constant": "constant-groups", "midpoint": "midpoint"}
CAPTURE: dict[str, Any] = {
    "scene": {"kind": "street", "seed": 0},
    "path": {"kind": "random-spline", "length_px": 360, "shake": {"rms_px": 1.0, "frequencies_hz": [25.0, 90.0, 180.0]}},
    "n_frames": 2400,
    "frame_shape": [254, 496],
}
Results: TypeAlias = dict[tuple[float, str, str, str], tuple[float, float, float] | str]
"""Mean error, largest error and loss of PSNR by flux, locator, graph and resampler; or why the run failed."""
HEADER = ("Flux", "Locator", "Graph", "Groups", "Mean", "Worst frame", "Below the oracle")


def simulate(folder: Path, flux: float) -> Path:
    """Write a capture with its truth beside it."""
    cube = folder / f"flux-{flux:g}.npy"
    spec = cube.with_suffix(".yaml")
    # JSON is YAML.
    spec.write_text(json.dumps({"version": 1, "source": {"use": "simulator", "with": CAPTURE | {"flux": flux}}}))
    program = [sys.executable, "-c", "from photonpano.cli import main; main()"]
    subprocess.run([*program, "simulate", str(spec), "--output", str(cube)], check=True, stdout=subprocess.DEVNULL)
    return cube


def measure(cube: Path, locator: str, graph: str, resampler: str) -> tuple[float, float, float]:
    """Return the mean and the largest corner error, in px, and the loss of PSNR compared with the oracle, in dB."""
    plan = parse_spec(
        {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 96_800}},
            "resample": {"use": RESAMPLERS[resampler], "with": {"group_size": GROUP_SIZE}},
            "locate": LOCATORS[locator],
            "graph": GRAPHS[graph] | {"disconnected": "largest"},
            "output": {"directory": str(cube.with_suffix(".run"))},
        }
    )
    result = run(plan)
    scores = evaluate(result.directory, cube.with_suffix(".truth.npz"))
    assert scores.below_oracle_db is not None
    return scores.trajectory.mean_px, scores.trajectory.max_px, scores.below_oracle_db


def bound_px(cube: Path) -> float:
    """Return the mean, over the capture, of the Cramer-Rao bound of an exposure of a known scene."""
    truth = load_truth(cube.with_suffix(".truth.npz"))
    assert truth.scene is not None
    height, width = truth.frame_shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    views = (cv2.warpPerspective(truth.scene, to_scene, (width, height), flags=flags) for to_scene in truth.homographies[::200])
    return float(np.mean([exposure_bound_px(view, BinaryResponse(), GROUP_SIZE) for view in views]))


def table(results: Results, bounds: dict[float, float]) -> list[str]:
    """Return the rows in Markdown."""
    lines = [f"| {' | '.join(HEADER)} |", "| --- " * len(HEADER) + "|"]
    for flux in bounds:
        for (at, *names), found in results.items():
            if at == flux:
                figures = found if isinstance(found, str) else "{:.3f} px | {:.2f} px | {:.2f} dB".format(*found)
                lines.append(f"| {flux:g} | {' | '.join(names)} | {figures} |")
        lines.append(f"| {flux:g} | *Cramer-Rao bound* | | | {bounds[flux]:.3f} px | | |")
    return lines


def plot(results: Results, bounds: dict[float, float], file: Path) -> None:
    """Draw the mean error of each variant over the flux."""
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    styles = {"chain": ":", "full": "-"}
    colours = {("opencv-sift", "constant"): "#c8a26b", ("opencv-sift", "midpoint"): "#a8641e"}
    colours |= {("direct", "constant"): "#8fb0cf", ("direct", "midpoint"): "#1f5a94"}
    fluxes = list(bounds)
    for locator, graph, resampler in itertools.product(LOCATORS, GRAPHS, RESAMPLERS):
        found = [results[flux, locator, graph, resampler] for flux in fluxes]
        errors = [np.nan if isinstance(each, str) else each[0] for each in found]
        label = f"{locator}, {graph}, {resampler}"
        axes.loglog(fluxes, errors, styles[graph], marker="o", markersize=4, color=colours[locator, resampler], label=label)
    axes.loglog(fluxes, list(bounds.values()), color="black", linewidth=1, label="Cramer-Rao bound")
    axes.set_xticks(fluxes, [f"{flux:g}" for flux in fluxes])
    axes.set_xticks([], minor=True)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_xlabel("flux (photons per pixel per frame)")
    axes.set_ylabel("mean corner error (px)")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right upper", frameon=False, title="locator, graph, groups")
    figure.savefig(file, dpi=110)


def main() -> None:
    """Measure everything, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="the page whose table is replaced")
    page = parser.parse_args().page
    require_places(page, ["table"])
    results: Results = {}
    bounds: dict[float, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        for flux in FLUXES:
            cube = simulate(Path(folder), flux)
            bounds[flux] = bound_px(cube)
            for names in itertools.product(LOCATORS, GRAPHS, RESAMPLERS):
                try:
                    results[(flux, *names)] = measure(cube, *names)
                except PhotonpanoError as error:
                    results[(flux, *names)] = f"failed: {str(error).splitlines()[0]} | | "
                print(flux, *names, results[(flux, *names)], file=sys.stderr, flush=True)
            cube.unlink()
    write_tables(page, {"table": table(results, bounds)})
    plot(results, bounds, page.parent.parent / "images" / "ablation.png")


if __name__ == "__main__":
    main()
